#include "services/map_server/map_server_service.h"

#include <fstream>
#include <set>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "common/bus/channels.h"
#include "orthonav/map_info_t.hpp"
#include "orthonav/map_tile_t.hpp"
#include "services/map_server/map_database_writer.h"
#include "tests/support/bus_client.h"
#include "tests/support/temporary_folder.h"

namespace orthonav::map_server {
namespace {

constexpr int64_t kStart = 1'700'000'000'000'000;

class MapServerOnTheBus : public testing::Test {
 protected:
  MapServerOnTheBus() {
    std::ofstream(folder_ / "map_server.yaml") << "part_period_us: 1000\nparts_per_period: 1\nfile: map.onmap\n";
    MapDescription map;
    map.fingerprint = "feedfeedfeedfeed";
    map.anchor = {48, 11, 500};
    map.metres_per_pixel = 0.3;
    map.tile_size = 45;
    map.east_max = 90;
    map.north_min = -45;
    map.tile_columns = 2;
    map.tile_rows = 1;
    map.keypoint_size = 8;
    map.keypoint_stride = 10;
    MapDescription coarse = map;
    coarse.fingerprint = "feedfeedfeedfee1";
    coarse.metres_per_pixel = 0.6;
    coarse.tile_size = 90;
    coarse.tile_columns = 1;
    MapDatabaseWriter writer(folder_ / "map.onmap", {map, coarse});
    TileFeatures tile;
    for (int i = 0; i < 25; ++i) {
      tile.positions.emplace_back(static_cast<float>(i) * 0.1F, -1.0F, 2.0F);
      tile.descriptors.insert(tile.descriptors.end(), 128, static_cast<uint8_t>(i % 251));
    }
    writer.write_block({{0, 0, tile}});
    tile.positions.resize(4);
    tile.descriptors.assign(4 * 128, 77);
    writer.write_block({{1, 0, tile}});
    writer.finish();
    service_ = std::make_unique<MapServerService>(node_, folder_.path());
    advance_to(kStart);
  }

  void pump() {
    while (bus_.handleTimeout(0) > 0) {
    }
  }
  void advance_to(int64_t utime) {
    node_.advance(utime);
    pump();
  }
  void ask(const std::string& fingerprint, const std::vector<int32_t>& tiles, int32_t part = -1) {
    map_tile_request_t request;
    request.utime = kStart;
    request.client = "test";
    request.fingerprint = fingerprint;
    request.tile = tiles;
    request.num_tiles = static_cast<int32_t>(tiles.size());
    request.part.assign(tiles.size(), part);
    bus_.publish(channel::kMapTileRequest, &request);
    pump();
  }

  lcm::LCM bus_{"memq://"};
  test::TemporaryFolder folder_;
  Node node_{{.service = "map_server"}, bus_};
  test::Collector<map_info_t> infos_{bus_, channel::kMapInfo};
  test::Collector<map_tile_t> tiles_{bus_, channel::kMapTile};
  std::unique_ptr<MapServerService> service_;
};

TEST_F(MapServerOnTheBus, SaysEachSecondWhatMapThereIs) {
  for (int i = 1; i <= 35; ++i) advance_to(kStart + i * 100'000);
  ASSERT_EQ(infos_.messages.size(), 6u);  // of two levels
  const map_info_t& coarse = infos_.messages[1];
  EXPECT_EQ(coarse.level, 1);
  EXPECT_EQ(coarse.fingerprint, "feedfeedfeedfee1");
  EXPECT_EQ(coarse.map_fingerprint, "feedfeedfeedfeed");
  const map_info_t& info = infos_.messages.front();
  EXPECT_EQ(info.level, 0);
  EXPECT_EQ(info.num_levels, 2);
  EXPECT_EQ(info.features, "rootsift");
  EXPECT_EQ(info.fingerprint, "feedfeedfeedfeed");
  EXPECT_EQ(info.map_name, "map.onmap");
  EXPECT_EQ(info.num_features, 25);
  EXPECT_EQ(info.tile_columns, 2);
  EXPECT_EQ(info.descriptor_size, 128);
  EXPECT_EQ(info.anchor_height, 500);
}

TEST_F(MapServerOnTheBus, SendsATileInPartsOfAPacketAndNotFasterThanAgreed) {
  ask("feedfeedfeedfeed", {0, 1});
  EXPECT_EQ(tiles_.messages.size(), 0u);
  for (int ms = 1; ms <= 10; ++ms) {
    advance_to(kStart + ms * 1000);
    EXPECT_LE(tiles_.messages.size(), static_cast<size_t>(ms));
  }
  ASSERT_EQ(tiles_.messages.size(), 4u);  // 25 features in three parts, and a tile without features in one
  std::set<float> east;
  for (int part = 0; part < 3; ++part) {
    const map_tile_t& message = tiles_.messages[static_cast<size_t>(part)];
    EXPECT_LE(message.getEncodedSize() + std::string(channel::kMapTile).size() + 1, 1400u);
    EXPECT_EQ(message.tile, 0);
    EXPECT_EQ(message.part, part);
    EXPECT_EQ(message.num_parts, 3);
    for (int i = 0; i < message.num_features; ++i) {
      const float x = message.position[static_cast<size_t>(i)][0];
      east.insert(x);
      EXPECT_EQ(message.descriptors[static_cast<size_t>(i) * 128 + 5], std::lround(x * 10) % 251);
    }
  }
  EXPECT_EQ(east.size(), 25u);
  EXPECT_EQ(tiles_.messages[3].tile, 1);
  EXPECT_EQ(tiles_.messages[3].num_features, 0);
  EXPECT_EQ(tiles_.messages[3].num_parts, 1);
}

TEST_F(MapServerOnTheBus, SendsATileOnceThatWasAskedForTwice) {
  ask("feedfeedfeedfeed", {1, 1});
  ask("feedfeedfeedfeed", {1});
  for (int ms = 1; ms <= 10; ++ms) advance_to(kStart + ms * 1000);
  EXPECT_EQ(tiles_.messages.size(), 1u);
  EXPECT_EQ(node_.health().counter("tiles.coalesced"), 2);
  ask("feedfeedfeedfeed", {1});
  for (int ms = 11; ms <= 20; ++ms) advance_to(kStart + ms * 1000);
  EXPECT_EQ(tiles_.messages.size(), 2u);
}

TEST_F(MapServerOnTheBus, CountsAndRefusesRequestsItCannotServe) {
  ask("0123456789abcdef", {0});
  ask("feedfeedfeedfeed", {-1, 2, 1 << 30});
  for (int ms = 1; ms <= 10; ++ms) advance_to(kStart + ms * 1000);
  EXPECT_EQ(node_.health().counter("rejected.request.other_map"), 1);
  EXPECT_EQ(node_.health().counter("rejected.request.no_such_tile"), 3);
  // Whoever asked is told that there is nothing to wait for.
  ASSERT_EQ(tiles_.messages.size(), 3u);
  EXPECT_EQ(tiles_.messages[2].tile, 1 << 30);
  EXPECT_EQ(tiles_.messages[2].num_parts, 0);
  ask("feedfeedfeedfeed", {0}, 3);
  for (int ms = 11; ms <= 20; ++ms) advance_to(kStart + ms * 1000);
  EXPECT_EQ(tiles_.messages.size(), 3u);
  EXPECT_EQ(node_.health().counter("rejected.request.no_such_part"), 1);
}

TEST_F(MapServerOnTheBus, SendsThePartThatWasAskedForAndTheLevel) {
  ask("feedfeedfeedfeed", {0}, 1);
  ask("feedfeedfeedfee1", {0});
  for (int ms = 1; ms <= 10; ++ms) advance_to(kStart + ms * 1000);
  ASSERT_EQ(tiles_.messages.size(), 2u);
  EXPECT_EQ(tiles_.messages[0].fingerprint, "feedfeedfeedfeed");
  EXPECT_EQ(tiles_.messages[0].part, 1);
  EXPECT_EQ(tiles_.messages[0].num_features, 9);
  EXPECT_EQ(tiles_.messages[1].fingerprint, "feedfeedfeedfee1");
  EXPECT_EQ(tiles_.messages[1].num_features, 4);
  EXPECT_EQ(tiles_.messages[1].descriptors[0], 77);
}

TEST_F(MapServerOnTheBus, RefusesATileThatIsDamaged) {
  const auto file = folder_ / "map.onmap";
  std::fstream damage(file, std::ios::binary | std::ios::in | std::ios::out);
  damage.seekp(-4 * 140 - 10, std::ios::end);  // in the finest level's tile
  damage.put('\x55');
  damage.close();
  ask("feedfeedfeedfeed", {0});
  ask("feedfeedfeedfee1", {0});
  for (int ms = 1; ms <= 10; ++ms) advance_to(kStart + ms * 1000);
  ASSERT_EQ(tiles_.messages.size(), 2u);
  EXPECT_EQ(tiles_.messages[0].tile, 0);
  EXPECT_EQ(tiles_.messages[0].num_parts, 0);
  EXPECT_EQ(tiles_.messages[1].num_features, 4);
  EXPECT_EQ(node_.health().counter("rejected.tile.damaged"), 1);
}

TEST(TileQueue, SendsOnceWhatIsAskedForTwiceAndHoldsNoMoreThanItsCapacity) {
  TileQueue queue(3);
  EXPECT_EQ(queue.add({0, 5, 2}), TileQueue::Outcome::kQueued);
  EXPECT_EQ(queue.add({0, 5, 2}), TileQueue::Outcome::kCoalesced);
  EXPECT_EQ(queue.add({1, 5, 2}), TileQueue::Outcome::kQueued);
  EXPECT_EQ(queue.add({0, 6, -1}), TileQueue::Outcome::kQueued);
  EXPECT_EQ(queue.add({0, 6, 7}), TileQueue::Outcome::kCoalesced) << "a part of a tile that comes whole";
  EXPECT_EQ(queue.add({0, 7, -1}), TileQueue::Outcome::kFull);
  EXPECT_EQ(queue.front().part, 2);
  queue.pop();
  EXPECT_EQ(queue.add({0, 5, 2}), TileQueue::Outcome::kQueued);
  EXPECT_EQ(queue.size(), 3u);
}

TEST(MapServer, WithoutAUsableMapItDoesNotStart) {
  lcm::LCM bus("memq://");
  Node node({.service = "map_server"}, bus);
  const test::TemporaryFolder folder;
  std::ofstream(folder / "map_server.yaml") << "{}\n";
  EXPECT_THROW(MapServerService(node, folder.path()), ConfigError);
  std::ofstream(folder / "map_server.yaml") << "part_peroid_us: 5\n";
  EXPECT_THROW(MapServerService(node, folder.path(), "x.onmap"), ConfigError);
  std::ofstream(folder / "map_server.yaml") << "{}\n";
  std::ofstream(folder / "bad.onmap") << "ONMAP";
  EXPECT_THROW(MapServerService(node, folder.path(), folder / "bad.onmap"), MapDatabaseError);
}

}  // namespace
}  // namespace orthonav::map_server
