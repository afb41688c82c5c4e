// The map over UDP that loses packets (tests/support/lossy-bus): server and client as in flight.
#include <chrono>
#include <cstdlib>
#include <fstream>
#include <random>
#include <string_view>

#include <gtest/gtest.h>

#include "common/bus/channels.h"
#include "common/bus/node.h"
#include "orthonav/health_t.hpp"
#include "services/map_server/map_database_writer.h"
#include "services/registration/map/map_message.h"
#include "tests/support/child_process.h"
#include "tests/support/temporary_folder.h"

namespace orthonav {
namespace {

using map_server::MapDescription;
using map_server::TileFeatures;
using registration::MapClient;
using registration::MapFeatures;

constexpr int kSide = 20;  // tiles

MapDescription large_map() {
  MapDescription map;
  map.fingerprint = "10c510c510c510c5";
  map.anchor = {48, 11, 500};
  map.metres_per_pixel = 0.3;
  map.tile_size = 45;
  map.east_max = kSide * 45;
  map.north_min = -kSide * 45;
  map.tile_columns = map.tile_rows = kSide;
  map.keypoint_size = 12;
  map.keypoint_stride = 10;
  return map;
}

// As many features to a tile as a 3 m grid has, here and there none.
void write_map(const std::filesystem::path& file) {
  std::mt19937 random(1);
  map_server::MapDatabaseWriter writer(file, {large_map()});
  for (int tile = 0; tile < kSide * kSide; ++tile) {
    TileFeatures features;
    for (int i = 0; i < (tile % 50 == 7 ? 0 : 225); ++i) {
      features.positions.emplace_back(static_cast<float>(random() % 900), static_cast<float>(random() % 900), 0.25F);
      for (int k = 0; k < 128; ++k) features.descriptors.push_back(static_cast<uint8_t>(random()));
    }
    writer.write_block({{0, tile, features}});
  }
  writer.finish();
}

TEST(MapOverALossyBus, EveryTileArrivesIntact) {
  const char* lossy = std::getenv("ORTHONAV_LOSSY_BUS");
  if (lossy == nullptr || std::string_view(lossy) != "yes") {
    GTEST_SKIP() << "needs a bus that loses packets, tests/support/lossy-bus: " << (lossy == nullptr ? "" : lossy);
  }
  const test::TemporaryFolder folder;
  write_map(folder / "map.onmap");
  std::ofstream(folder / "map_server.yaml") << "file: map.onmap\n";
  const test::ChildProcess server({test::program("orthonav-map-server"), "--config", folder.path()},
                                  folder / "server.txt");

  using Clock = std::chrono::steady_clock;
  Node node({.service = "client"});
  MapClient client(registration::MapClientOptions{});
  std::optional<MapFeatures> features;
  Clock::time_point begin, end;
  int64_t parts = 0, requests = 0, repeated = 0;
  node.subscribe<map_info_t>(channel::kMapInfo, Delivery::kLatest, [&](const map_info_t& info) {
    if (client.offer(registration::level_of(info))) begin = Clock::now();
  });
  node.subscribe<map_tile_t>(channel::kMapTile, Delivery::kAll, [&](const map_tile_t& tile) {
    ++parts;
    if (registration::add_tile(client, tile, node.steady_now()) == registration::TileStore::Outcome::kDuplicate)
      ++repeated;
    if (auto ready = client.take_ready()) {
      features = std::move(ready);
      end = Clock::now();
      node.stop();
    }
  });
  node.every(std::chrono::milliseconds(50), [&] {
    if (auto request = registration::next_request(client, "client", node.steady_now())) {
      ++requests;
      request->utime = node.now();
      node.publish(channel::kMapTileRequest, *request);
    }
  });
  const auto deadline = Clock::now() + std::chrono::seconds(60);
  node.every(std::chrono::milliseconds(500), [&] {
    if (Clock::now() > deadline) node.stop();
  });
  node.run();

  ASSERT_TRUE(features) << client.waiting_for();
  const TileFeatures expected = map_server::MapDatabase(folder / "map.onmap").all_tiles(0);
  ASSERT_EQ(features->positions.size(), expected.positions.size());
  EXPECT_EQ(features->positions, expected.positions);
  EXPECT_TRUE(std::equal(expected.descriptors.begin(), expected.descriptors.end(), features->descriptors.data));
  EXPECT_GT(client.store().num_asked_again(), 0) << "the bus lost nothing: the test shows nothing";
  const auto needed = static_cast<int64_t>(expected.positions.size() / 9);
  std::printf(
      "%d tiles, %.1f MB, in %.2f s: %ld requests, %ld packets needed, %ld came and %ld of them twice; asked again for "
      "%ld tiles, %ld of the parts one by one\n",
      kSide * kSide, 140e-6 * static_cast<double>(expected.positions.size()),
      std::chrono::duration<double>(end - begin).count(), requests, needed, parts, repeated,
      client.store().num_asked_again(), client.store().num_parts_again());
}

}  // namespace
}  // namespace orthonav
