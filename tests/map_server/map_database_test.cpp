#include "services/map_server/map_database.h"

#include <filesystem>
#include <fstream>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "tests/support/temporary_folder.h"

namespace orthonav::map_server {
namespace {

using testing::HasSubstr;

MapDescription small_map() {
  MapDescription map;
  map.fingerprint = "0123456789abcdef";
  map.anchor = {48.5, 9.25, 512.0};
  map.metres_per_pixel = 0.3;
  map.east_min = -0.3;
  map.east_max = 89.7;
  map.north_min = -45.0;
  map.north_max = 0.0;
  map.keypoint_size = 8;
  map.keypoint_stride = 10;
  map.tile_size = 45;
  map.tile_columns = 2;
  map.tile_rows = 1;
  map.has_surface = true;
  return map;
}

TileFeatures features(int count, int seed) {
  TileFeatures tile;
  for (int i = 0; i < count; ++i) {
    tile.positions.emplace_back(static_cast<float>(i), static_cast<float>(-seed), 0.5F);
    for (int k = 0; k < 128; ++k) tile.descriptors.push_back(static_cast<uint8_t>((i * 7 + k * seed) % 256));
  }
  return tile;
}

class MapDatabaseFile : public testing::Test {
 protected:
  MapDatabaseFile() {
    MapDatabaseWriter writer(file_, small_map());
    writer.write_tile(1, features(5, 3));
    writer.write_tile(0, features(2, 4));
    writer.finish();
    std::ifstream in(file_, std::ios::binary);
    bytes_.assign(std::istreambuf_iterator<char>(in), {});
  }

  std::filesystem::path variant(const std::string& bytes) {
    const auto file = folder_ / "variant.onmap";
    std::ofstream(file, std::ios::binary) << bytes;
    return file;
  }

  std::string error_of(const std::string& bytes) {
    try {
      const MapDatabase database(variant(bytes));
    } catch (const MapDatabaseError& error) {
      return error.what();
    }
    return "no error";
  }

  test::TemporaryFolder folder_;
  std::filesystem::path file_ = folder_ / "map.onmap";
  std::string bytes_;
};

TEST_F(MapDatabaseFile, GivesBackWhatWasWritten) {
  const MapDatabase database(file_);
  const MapDescription& map = database.description();
  EXPECT_EQ(map.fingerprint, "0123456789abcdef");
  EXPECT_EQ(map.anchor.latitude_deg, 48.5);
  EXPECT_EQ(map.anchor.longitude_deg, 9.25);
  EXPECT_EQ(map.anchor.height, 512.0);
  EXPECT_EQ(map.east_min, -0.3);
  EXPECT_EQ(map.keypoint_size, 8);
  EXPECT_EQ(map.num_features, 7);
  EXPECT_TRUE(map.has_surface);
  const TileView tile = database.tile(1);
  const TileFeatures expected = features(5, 3);
  ASSERT_EQ(tile.positions.size(), 5u);
  EXPECT_TRUE(std::equal(tile.positions.begin(), tile.positions.end(), expected.positions.begin()));
  EXPECT_TRUE(std::equal(tile.descriptors.begin(), tile.descriptors.end(), expected.descriptors.begin()));
  EXPECT_EQ(database.tile(0).positions.size(), 2u);
  EXPECT_THROW((void)database.tile(2), std::out_of_range);
  EXPECT_THROW((void)database.tile(-1), std::out_of_range);
}

TEST_F(MapDatabaseFile, EveryTruncationIsAnErrorThatNamesFileAndRemedy) {
  for (size_t size = 0; size < bytes_.size(); size += 7) {
    const std::string error = error_of(bytes_.substr(0, size));
    EXPECT_THAT(error, HasSubstr("variant.onmap")) << size;
    EXPECT_THAT(error, HasSubstr("orthonav-build-map")) << size;
  }
  EXPECT_THAT(error_of(bytes_.substr(0, bytes_.size() - 1)), HasSubstr("truncated"));
  EXPECT_THAT(error_of(bytes_ + "x"), HasSubstr("truncated"));
}

TEST_F(MapDatabaseFile, EveryDamagedByteIsFound) {
  for (size_t i = 0; i < bytes_.size(); ++i) {
    std::string damaged = bytes_;
    damaged[i] = static_cast<char>(damaged[i] ^ 0x10);
    EXPECT_THAT(error_of(damaged), HasSubstr("orthonav-build-map")) << "byte " << i;
  }
}

TEST_F(MapDatabaseFile, AnotherVersionIsNamed) {
  std::string other = bytes_;
  other[8] = 9;
  EXPECT_THAT(error_of(other), HasSubstr("version 9"));
}

TEST_F(MapDatabaseFile, AMissingFileIsNamed) {
  try {
    const MapDatabase database(folder_ / "nowhere.onmap");
    FAIL();
  } catch (const MapDatabaseError& error) {
    EXPECT_THAT(error.what(), HasSubstr("nowhere.onmap"));
  }
}

TEST_F(MapDatabaseFile, ABuildBrokenOffLeavesNothing) {
  const auto file = folder_ / "broken_off.onmap";
  {
    MapDatabaseWriter writer(file, small_map());
    writer.write_tile(0, features(3, 1));
  }
  int files = 0;
  for (const auto& entry : std::filesystem::directory_iterator(folder_.path())) {
    files += entry.path().filename().string().starts_with("broken_off") ? 1 : 0;
  }
  EXPECT_EQ(files, 0);
}

TEST(MapDescription, PutsAPositionIntoItsTile) {
  const MapDescription map = small_map();
  EXPECT_EQ(map.tile_of(0, -1), 0);
  EXPECT_EQ(map.tile_of(44.8, -1), 1);
  EXPECT_EQ(map.tile_of(89.8, -1), -1);
  EXPECT_EQ(map.tile_of(10, 0.1), -1);
  EXPECT_EQ(map.tile_of(std::nan(""), 0), -1);
}

}  // namespace
}  // namespace orthonav::map_server
