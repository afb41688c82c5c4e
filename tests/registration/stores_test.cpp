#include <limits>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "services/registration/heading_buffer.h"
#include "services/registration/map/tile_store.h"

namespace orthonav::registration {
namespace {

using testing::ElementsAre;
using testing::IsEmpty;
using Outcome = TileStore::Outcome;

TEST(HeadingBuffer, InterpolatesTheShortWayRound) {
  HeadingBuffer buffer(300'000);
  ASSERT_TRUE(buffer.add(1'000'000, {6.2, 0.05}));
  ASSERT_TRUE(buffer.add(1'100'000, {0.1, 0.07}));
  const auto heading = buffer.at(1'050'000);
  ASSERT_TRUE(heading);
  const double middle = (6.2 - 2 * M_PI + 0.1) / 2;
  EXPECT_NEAR(std::remainder(heading->value - middle, 2 * M_PI), 0, 1e-12);
  EXPECT_NEAR(heading->stddev, 0.06, 1e-12);
  EXPECT_NEAR(buffer.at(1'100'000)->value, 0.1, 1e-12);
}

TEST(HeadingBuffer, SaysNothingOfTimesFarFromItsSamples) {
  HeadingBuffer buffer(300'000);
  EXPECT_FALSE(buffer.at(1'000'000));
  buffer.add(1'000'000, {1, 0.05});
  EXPECT_NEAR(buffer.at(1'200'000)->value, 1, 1e-12);
  EXPECT_FALSE(buffer.covers(1'200'000));
  EXPECT_FALSE(buffer.at(1'300'001));
  EXPECT_FALSE(buffer.at(600'000));
  buffer.add(3'000'000, {2, 0.05});
  EXPECT_FALSE(buffer.at(2'000'000));
  EXPECT_NEAR(buffer.at(2'900'000)->value, 2, 1e-12);
}

TEST(HeadingBuffer, RefusesWhatIsNotFiniteOrOutOfOrder) {
  HeadingBuffer buffer(300'000);
  EXPECT_FALSE(buffer.add(1, {std::numeric_limits<double>::quiet_NaN(), 0.05}));
  EXPECT_TRUE(buffer.add(5, {1, 0.05}));
  EXPECT_FALSE(buffer.add(5, {1, 0.05}));
  EXPECT_FALSE(buffer.add(4, {1, 0.05}));
}

struct Part {
  std::vector<float> positions;
  std::vector<uint8_t> descriptors;
  TilePart part;
  Part(int tile, int index, int num_parts, int count, float east = 0) {
    for (int i = 0; i < count; ++i) {
      for (const float value : {east, 1.0F, 2.0F}) positions.push_back(value);
    }
    descriptors.assign(static_cast<size_t>(count) * 128, static_cast<uint8_t>(east));
    part = {tile, index, num_parts, positions, descriptors};
  }
};

MapLayout layout(int64_t features) {
  return {"abc", 2, 2, features, 45, 0, -90};
}

constexpr int64_t kAmple = 1'000'000;

std::vector<int> tiles_of(const std::vector<TileRequest>& requests) {
  std::vector<int> tiles;
  for (const TileRequest& request : requests) tiles.push_back(request.tile);
  return tiles;
}

TEST(TileStore, PutsTogetherWhatCameInAnyOrder) {
  TileStore store(layout(6), kAmple);
  store.want({0, 1, 2, 3});
  EXPECT_EQ(store.add(Part(3, 1, 2, 1, 31).part, 0), Outcome::kAccepted);
  EXPECT_EQ(store.add(Part(0, 0, 1, 2, 1).part, 0), Outcome::kAccepted);
  EXPECT_EQ(store.add(Part(2, 0, 1, 0).part, 0), Outcome::kAccepted);
  EXPECT_EQ(store.add(Part(3, 0, 2, 1, 30).part, 0), Outcome::kAccepted);
  EXPECT_EQ(store.add(Part(0, 0, 1, 2, 1).part, 0), Outcome::kDuplicate);
  EXPECT_FALSE(store.complete());
  EXPECT_EQ(store.add(Part(1, 0, 1, 2, 10).part, 0), Outcome::kAccepted);
  ASSERT_TRUE(store.complete());
  EXPECT_EQ(store.memory_used(), 6 * kFeatureMemory);
  for (const MapFeatures& features : {store.collect(), store.take()}) {
    std::vector<float> east;
    for (const auto& position : features.positions) east.push_back(position.x());
    EXPECT_THAT(east, ElementsAre(1, 1, 10, 10, 30, 31));
    ASSERT_EQ(features.descriptors.rows, 6);
    EXPECT_EQ(features.descriptors.at<uchar>(5, 127), 31);
  }
  EXPECT_EQ(store.memory_used(), 0);
}

TEST(TileStore, AsksForFewAtATimeAndAgainForWhatDidNotCome) {
  TileStore store(layout(10), kAmple);
  store.want({0, 1, 2, 3, 7, -1});  // two of them do not exist
  EXPECT_EQ(store.num_wanted(), 4);
  EXPECT_THAT(tiles_of(store.ask(0, 2, 1000)), ElementsAre(0, 1));
  EXPECT_THAT(tiles_of(store.ask(10, 2, 1000)), IsEmpty());
  store.add(Part(1, 0, 1, 1).part, 20);
  EXPECT_THAT(tiles_of(store.ask(30, 2, 1000)), ElementsAre(2));
  EXPECT_EQ(store.num_asked_again(), 0);
  EXPECT_THAT(tiles_of(store.ask(1000, 2, 1000)), ElementsAre(0));
  EXPECT_EQ(store.num_asked_again(), 1);
  EXPECT_THAT(tiles_of(store.ask(5000, 10, 1000)), ElementsAre(0, 2, 3));
}

TEST(TileStore, AsksForTheLostPartsOfATileThatMostlyCame) {
  TileStore store(layout(10), kAmple);
  store.want({2});
  store.ask(0, 8, 1000);
  for (const int part : {0, 2, 3, 5}) store.add(Part(2, part, 6, 1).part, 100);
  EXPECT_TRUE(store.ask(1050, 8, 1000).empty()) << "parts still come";
  const auto requests = store.ask(1100, 8, 1000);
  ASSERT_EQ(requests.size(), 2u);
  EXPECT_EQ(requests[0].part, 1);
  EXPECT_EQ(requests[1].part, 4);
  EXPECT_EQ(store.num_parts_again(), 2);
}

TEST(TileStore, KeepsWithinItsMemoryAndGivesUpWhatWasWantedLongestAgo) {
  TileStore store(layout(1000), 6 * kFeatureMemory);
  const auto come = [&](int tile) { return store.add(Part(tile, 0, 1, 2).part, 0); };
  store.want({0, 1});
  come(0);
  come(1);
  store.want({1, 2});
  come(2);
  EXPECT_EQ(store.memory_used(), 6 * kFeatureMemory);
  store.want({2, 3});
  EXPECT_EQ(store.num_complete(), 1);
  come(3);
  EXPECT_EQ(store.num_given_up(), 1);
  EXPECT_EQ(store.memory_used(), 6 * kFeatureMemory);
  store.want({1, 0});
  EXPECT_EQ(store.num_complete(), 1) << "tile 1 was still there, tile 0 had been given up";
  // All four are wanted, three find room: the least important is left out, and nothing waits for it.
  store.want({3, 1, 0, 2});
  come(3);
  come(0);
  come(2);
  EXPECT_LE(store.memory_used(), 6 * kFeatureMemory);
  EXPECT_EQ(store.num_beyond_budget(), 1);
  EXPECT_TRUE(store.complete());
  EXPECT_EQ(store.collect().positions.size(), 6u);
}

TEST(TileStore, DoesNotWaitForATileThatTheServerRefuses) {
  TileStore store(layout(10), kAmple);
  store.want({0, 1});
  store.ask(0, 8, 1000);
  store.add(Part(0, 0, 1, 2).part, 0);
  EXPECT_EQ(store.add(Part(1, 0, 0, 0).part, 0), Outcome::kRefused);
  EXPECT_EQ(store.add(Part(0, 0, 0, 0).part, 0), Outcome::kDuplicate) << "it is here already";
  EXPECT_TRUE(store.complete());
  EXPECT_EQ(store.num_refused(), 1);
  EXPECT_TRUE(store.ask(10'000, 8, 1000).empty());
}

TEST(TileStore, RefusesMalformedParts) {
  TileStore store(layout(3), kAmple);
  store.want({0, 1});
  EXPECT_EQ(store.add(Part(4, 0, 1, 1).part, 0), Outcome::kMalformed);
  EXPECT_EQ(store.add(Part(-1, 0, 1, 1).part, 0), Outcome::kMalformed);
  EXPECT_EQ(store.add(Part(0, 1, 1, 1).part, 0), Outcome::kMalformed);
  EXPECT_EQ(store.add(Part(0, 0, -1, 1).part, 0), Outcome::kMalformed);
  EXPECT_EQ(store.add(Part(0, 0, 1'000'000'000, 1).part, 0), Outcome::kMalformed);
  EXPECT_EQ(store.add(Part(0, 0, 1, 4).part, 0), Outcome::kMalformed);  // more than the map has
  EXPECT_EQ(store.add(Part(0, 0, 1, 1, std::numeric_limits<float>::infinity()).part, 0), Outcome::kMalformed);
  Part short_descriptors(0, 0, 1, 2);
  short_descriptors.part.descriptors = short_descriptors.part.descriptors.first(200);
  EXPECT_EQ(store.add(short_descriptors.part, 0), Outcome::kMalformed);
  EXPECT_EQ(store.add(Part(2, 0, 1, 1).part, 0), Outcome::kUnwanted);
  EXPECT_EQ(store.add(Part(1, 0, 2, 1).part, 0), Outcome::kAccepted);
  EXPECT_EQ(store.add(Part(1, 1, 3, 1).part, 0), Outcome::kMalformed);  // another number of parts
  EXPECT_EQ(store.memory_used(), kFeatureMemory);
}

TEST(MapLayout, SaysWhatIsWrongWithAMap) {
  EXPECT_EQ(layout(5).problem(), "");
  EXPECT_NE(layout(0).problem(), "");
  EXPECT_NE((MapLayout{"", 2, 2, 5, 45, 0, 0}).problem(), "");
  EXPECT_NE((MapLayout{"a", 0, 2, 5, 45, 0, 0}).problem(), "");
  EXPECT_NE((MapLayout{"a", 2'000'000'000, 2'000'000'000, 5, 45, 0, 0}).problem(), "");
  EXPECT_NE((MapLayout{"a", 2, 2, 5, 0, 0, 0}).problem(), "");
  EXPECT_NE((MapLayout{"a", 2, 2, 5, 45, std::numeric_limits<double>::quiet_NaN(), 0}).problem(), "");
  EXPECT_THROW(TileStore(layout(0), 1), std::invalid_argument);
}

}  // namespace
}  // namespace orthonav::registration
