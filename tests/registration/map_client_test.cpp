#include "services/registration/map/map_client.h"

#include <limits>
#include <set>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

namespace orthonav::registration {
namespace {

using testing::HasSubstr;

constexpr int kPerTile = 10;

// A map of 100 x 100 tiles of 50 m, its corner 0 at the south-west.
MapLevel level_of(int level, int num_levels, const std::string& map = "m") {
  MapLevel result;
  result.map_fingerprint = map;
  result.level = level;
  result.num_levels = num_levels;
  result.anchor = {48, 11, 500};
  result.geometry = {0.3 * (1 << level), 12, 10};
  const int side = 100 >> level;
  result.layout = {map + std::to_string(level), side, side, side * side * kPerTile, 50.0 * (1 << level), 0, -5000};
  return result;
}

// Gives the client what it asks for; says the tiles it got.
std::set<int> serve(MapClient& client, int64_t utime) {
  const std::vector<float> positions(3 * kPerTile, 1.0F);
  const std::vector<uint8_t> descriptors(128 * kPerTile, 7);
  std::set<int> served;
  for (auto requests = client.requests(utime); !requests.empty(); requests = client.requests(utime)) {
    for (const TileRequest& request : requests) {
      client.add({request.tile, 0, 1, positions, descriptors}, utime);
      served.insert(request.tile);
    }
  }
  return served;
}

TEST(TilesAlong, CoverTheWayAheadTheNearestFirst) {
  const MapLayout layout = level_of(0, 1).layout;
  const auto tiles = tiles_along(layout, {2525, -2475}, {500, 0}, 120);
  ASSERT_FALSE(tiles.empty());
  EXPECT_EQ(tiles.front(), 50 * 100 + 50);
  const std::set<int> set(tiles.begin(), tiles.end());
  EXPECT_EQ(set.size(), tiles.size());
  for (int row = 0; row < 100; ++row) {
    for (int column = 0; column < 100; ++column) {
      const double x = (column + 0.5) * 50, y = (row + 0.5) * 50 - 5000;
      const double dx = std::max({2525 - x, 0.0, x - 3025});
      const bool near = std::hypot(dx, y + 2475) <= 120;
      EXPECT_EQ(set.contains(row * 100 + column), near) << column << " " << row;
    }
  }
  EXPECT_TRUE(tiles_along(layout, {-9000, 0}, {0, 0}, 120).empty()) << "outside the map";
}

TEST(LevelFor, TakesPixelsAsWideAsTheCamerasAndKeepsThemThroughSmallClimbs) {
  const std::vector<double> widths{0.3, 0.6, 1.2};
  EXPECT_EQ(level_for(0.13, widths, -1), 0);
  EXPECT_EQ(level_for(0.39, widths, -1), 0);
  EXPECT_EQ(level_for(0.59, widths, -1), 1);
  EXPECT_EQ(level_for(1.5, widths, -1), 2);
  EXPECT_EQ(level_for(50, widths, -1), 2);
  EXPECT_EQ(level_for(0.42, widths, -1), 1);
  EXPECT_EQ(level_for(0.42, widths, 0), 0) << "nearly as good";
  EXPECT_EQ(level_for(0.5, widths, 0), 1);
  EXPECT_EQ(level_for(0.38, widths, 1), 1);
  EXPECT_EQ(level_for(0.3, widths, 1), 0);
}

TEST(MapClient, FetchesAMapThatFitsWholeAndHandsItOutOnce) {
  MapClientOptions options;
  options.memory = 100 * 100 * kPerTile * kFeatureMemory;
  MapClient client(options);
  EXPECT_THAT(client.waiting_for(), HasSubstr("MAP_INFO"));
  EXPECT_TRUE(client.offer(level_of(0, 1)));
  EXPECT_FALSE(client.offer(level_of(0, 1)));
  EXPECT_FALSE(client.take_ready());
  EXPECT_EQ(serve(client, 0).size(), 10'000u);
  const auto features = client.take_ready();
  ASSERT_TRUE(features);
  EXPECT_EQ(features->positions.size(), 100'000u);
  EXPECT_FALSE(client.take_ready());
  EXPECT_EQ(client.store().memory_used(), 0) << "the map is not held twice";
  EXPECT_TRUE(client.requests(1'000'000'000).empty());
  EXPECT_TRUE(client.offer(level_of(0, 1, "other")));
  EXPECT_FALSE(client.requests(1'000'000'000).empty());
}

TEST(MapClient, FetchesTheNeighbourhoodAndTheWayAheadOfALargeMap) {
  MapClientOptions options;
  options.memory = 1000 * kPerTile * kFeatureMemory;
  options.radius = 400;
  options.prefetch = 20;
  MapClient client(options);
  client.offer(level_of(0, 1));
  EXPECT_TRUE(client.requests(0).empty());
  EXPECT_THAT(client.waiting_for(), HasSubstr("map.start"));

  client.move({1000, -2500}, {30, 0}, 5);
  std::set<int> first = serve(client, 0);
  EXPECT_TRUE(first.contains(50 * 100 + 20));
  EXPECT_TRUE(first.contains(50 * 100 + 38)) << "600 m ahead and the radius";
  EXPECT_FALSE(first.contains(50 * 100 + 5));
  ASSERT_TRUE(client.take_ready());

  client.move({1050, -2500}, {30, 0}, 5);
  EXPECT_TRUE(client.requests(1000).empty()) << "still well inside";
  client.move({1200, -2500}, {30, 0}, 5);
  const std::set<int> second = serve(client, 2000);
  EXPECT_FALSE(second.empty());
  for (const int tile : second) EXPECT_FALSE(first.contains(tile)) << "what is here is not asked for again";
  EXPECT_TRUE(client.take_ready());
  // A long flight stays within the memory.
  for (int east = 1400; east < 4500; east += 200) {
    client.move({static_cast<double>(east), -2500}, {30, 0}, 5);
    serve(client, 10 * east);
    EXPECT_TRUE(client.take_ready());
    EXPECT_LE(client.store().memory_used(), options.memory);
  }
  EXPECT_GT(client.store().num_given_up(), 100);
  EXPECT_EQ(client.store().num_beyond_budget(), 0);
}

TEST(MapClient, BeginsALargeMapWhereItIsTold) {
  MapClientOptions options;
  options.memory = 1000 * kPerTile * kFeatureMemory;
  options.radius = 300;
  const MapLevel level = level_of(0, 1);
  const EnuFrame frame(level.anchor);
  options.start = frame.to_geodetic({2525, -2475, 0});
  MapClient client(options);
  client.offer(level);
  const std::set<int> tiles = serve(client, 0);
  EXPECT_TRUE(tiles.contains(50 * 100 + 50));
  EXPECT_NEAR(static_cast<double>(tiles.size()), M_PI * 36, 8);
  EXPECT_TRUE(client.take_ready());
}

TEST(MapClient, ChoosesTheLevelOnceItKnowsHowHighTheCameraIs) {
  MapClient client(MapClientOptions{});
  for (int i = 0; i < 3; ++i) client.offer(level_of(i, 3));
  EXPECT_EQ(client.level(), nullptr);
  EXPECT_THAT(client.waiting_for(), HasSubstr("VIO_KEYFRAME"));
  client.see(std::numeric_limits<double>::quiet_NaN());
  EXPECT_EQ(client.level(), nullptr);
  client.see(0.6);
  ASSERT_NE(client.level(), nullptr);
  EXPECT_EQ(client.level()->level, 1);
  EXPECT_EQ(serve(client, 0).size(), 2500u);
  EXPECT_EQ(client.take_ready()->positions.size(), 25'000u);
  client.see(0.2);  // it came down
  EXPECT_EQ(client.level()->level, 0);
  EXPECT_EQ(serve(client, 1).size(), 10'000u);
  EXPECT_TRUE(client.take_ready());
}

TEST(MapClient, FetchesAgainWhatIsNotAsAnnounced) {
  MapClientOptions options;
  MapClient client(options);
  MapLevel level = level_of(0, 1);
  level.layout.num_features = 99'999;
  client.offer(level);
  serve(client, 0);
  EXPECT_FALSE(client.take_ready());
  EXPECT_EQ(client.num_mismatched(), 1);
  EXPECT_FALSE(client.requests(1).empty());
}

TEST(MapClient, ReadsItsConfigurationAndRefusesHalfAStart) {
  ConfigNode node = ConfigNode::parse("memory_mb: 10\nstart: {latitude_deg: 48, longitude_deg: 11}", "r.yaml");
  const MapClientOptions options = MapClientOptions::from_config(node);
  EXPECT_EQ(options.memory, 10'000'000);
  ASSERT_TRUE(options.start);
  EXPECT_EQ(options.start->longitude_deg, 11);
  ConfigNode half = ConfigNode::parse("start: {latitude_deg: 48}", "r.yaml");
  EXPECT_THROW(MapClientOptions::from_config(half), ConfigError);
}

}  // namespace
}  // namespace orthonav::registration
