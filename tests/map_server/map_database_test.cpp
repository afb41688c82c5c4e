#include "services/map_server/map_database.h"

#include <csignal>
#include <filesystem>
#include <fstream>
#include <future>

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/resource.h>

#include "services/map_server/map_database_writer.h"
#include "tests/support/temporary_folder.h"

namespace orthonav::map_server {
namespace {

using testing::AnyOf;
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
  map.features = FeatureKind::kRootSift;
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

// Two levels, the coarser of one tile.
std::vector<MapDescription> two_levels() {
  MapDescription coarse = small_map();
  coarse.fingerprint = "0123456789abcdee";
  coarse.metres_per_pixel = 0.6;
  coarse.tile_size = 90;
  coarse.tile_columns = 1;
  return {small_map(), coarse};
}

// Writes blocks from `first` to `last`, of three.
void write_blocks(MapDatabaseWriter& writer, int first, int last) {
  for (int block = first; block <= last; ++block) {
    writer.count_left_out(block == 2 ? 1 : 0, 10 + block, 20 + block);
    if (block == 0) writer.write_block({{0, 1, features(5, 3)}});
    if (block == 1) writer.write_block({{0, 0, features(2, 4)}});
    if (block == 2) writer.write_block({{1, 0, features(3, 5)}});
  }
}

void write(const std::filesystem::path& file) {
  MapDatabaseWriter writer(file, two_levels());
  write_blocks(writer, 0, 2);
  writer.finish();
}

std::string bytes_of(const std::filesystem::path& file) {
  std::ifstream in(file, std::ios::binary);
  return {std::istreambuf_iterator<char>(in), {}};
}

class MapDatabaseFile : public testing::Test {
 protected:
  MapDatabaseFile() {
    write(file_);
    bytes_ = bytes_of(file_);
  }

  std::filesystem::path variant(const std::string& bytes) {
    auto file = folder_ / "variant.onmap";
    std::ofstream(file, std::ios::binary) << bytes;
    return file;
  }

  // Of opening and reading all of a file.
  std::string error_of(const std::string& bytes) {
    try {
      MapDatabase(variant(bytes)).verify();
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
  ASSERT_EQ(database.levels().size(), 2u);
  const MapDescription& map = database.levels()[0];
  EXPECT_EQ(map.fingerprint, "0123456789abcdef");
  EXPECT_EQ(map.anchor.latitude_deg, 48.5);
  EXPECT_EQ(map.anchor.longitude_deg, 9.25);
  EXPECT_EQ(map.anchor.height, 512.0);
  EXPECT_EQ(map.east_min, -0.3);
  EXPECT_EQ(map.keypoint_size, 8);
  EXPECT_EQ(map.num_features, 7);
  EXPECT_EQ(map.num_without_data, 21);
  EXPECT_EQ(map.num_without_texture, 41);
  EXPECT_TRUE(map.has_surface);
  EXPECT_EQ(map.features, FeatureKind::kRootSift);
  EXPECT_EQ(database.levels()[1].fingerprint, "0123456789abcdee");
  EXPECT_EQ(database.levels()[1].tile_size, 90);
  EXPECT_EQ(database.num_features(), 10);
  const auto expect_tile = [&](int level, int index, const TileFeatures& expected) {
    const TileFeatures tile = database.tile(level, index);
    EXPECT_EQ(tile.positions, expected.positions);
    EXPECT_EQ(tile.descriptors, expected.descriptors);
  };
  expect_tile(0, 0, features(2, 4));
  expect_tile(0, 1, features(5, 3));
  expect_tile(1, 0, features(3, 5));
  EXPECT_THROW((void)database.tile(0, 2), std::out_of_range);
  EXPECT_THROW((void)database.tile(0, -1), std::out_of_range);
  EXPECT_THROW((void)database.tile(1, 1), std::out_of_range);
  EXPECT_THROW((void)database.tile(2, 0), std::out_of_range);
  database.verify();
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

TEST_F(MapDatabaseFile, ATileDamagedAfterOpeningIsNotServed) {
  const auto file = variant(bytes_);
  const MapDatabase database(file);
  std::string damaged = bytes_;
  damaged[damaged.size() - 1] ^= 1;
  variant(damaged);
  EXPECT_THROW((void)database.tile(1, 0), MapDatabaseError);
  EXPECT_EQ(database.tile(0, 0).positions.size(), 2u);
  std::filesystem::resize_file(file, bytes_.size() - 3 * 140);
  EXPECT_THROW((void)database.tile(1, 0), MapDatabaseError);
}

class MapDatabaseBuild : public testing::Test {
 protected:
  MapDatabaseBuild() {
    write(folder_ / "whole.onmap");
    whole_ = bytes_of(folder_ / "whole.onmap");
  }
  // A build that ends after so many blocks without a word, as if it had been killed.
  void build_up_to(int blocks) {
    MapDatabaseWriter writer(file_, two_levels());
    write_blocks(writer, static_cast<int>(writer.num_blocks()), blocks - 1);
  }
  // Goes on to the end; says how many blocks were there already.
  int64_t go_on() {
    MapDatabaseWriter writer(file_, two_levels());
    const int64_t kept = writer.num_blocks();
    write_blocks(writer, static_cast<int>(kept), 2);
    writer.finish();
    return kept;
  }

  test::TemporaryFolder folder_;
  std::filesystem::path file_ = folder_ / "resumed.onmap";
  std::filesystem::path unfinished_ = folder_ / "resumed.onmap.unfinished";
  std::filesystem::path journal_ = folder_ / "resumed.onmap.journal";
  std::string whole_;
};

TEST_F(MapDatabaseBuild, GoesOnAfterTheFinishedBlocksToTheSameBytes) {
  for (int blocks = 0; blocks <= 3; ++blocks) {
    build_up_to(blocks);
    EXPECT_FALSE(std::filesystem::exists(file_)) << "an unfinished build must not look like a map";
    EXPECT_EQ(std::filesystem::exists(unfinished_), blocks > 0);
    EXPECT_EQ(go_on(), blocks);
    EXPECT_EQ(bytes_of(file_), whole_);
    EXPECT_FALSE(std::filesystem::exists(unfinished_));
    EXPECT_FALSE(std::filesystem::exists(journal_));
    std::filesystem::remove(file_);
  }
}

TEST_F(MapDatabaseBuild, KeepsNoBlockThatDoesNotHold) {
  build_up_to(2);
  const std::string data = bytes_of(unfinished_);
  const std::string journal = bytes_of(journal_);
  const auto restore = [&](const std::string& data_bytes, const std::string& journal_bytes) {
    std::ofstream(unfinished_, std::ios::binary) << data_bytes;
    std::ofstream(journal_, std::ios::binary) << journal_bytes;
  };
  // Half-written ends, as a kill or a power cut leaves them.
  restore(data + std::string(50, 'x'), journal + std::string(20, 'x'));
  EXPECT_EQ(go_on(), 2);
  EXPECT_EQ(bytes_of(file_), whole_);
  for (size_t size = 0; size < journal.size(); size += 5) {
    restore(data, journal.substr(0, size));
    EXPECT_LT(go_on(), 2);
    EXPECT_EQ(bytes_of(file_), whole_) << size;
  }
  restore(data.substr(0, data.size() - 1), journal);
  EXPECT_EQ(go_on(), 1);
  EXPECT_EQ(bytes_of(file_), whole_);
  std::string damaged = data;
  damaged[damaged.size() - 2 * 140 - 1] ^= 4;  // of the first block
  restore(damaged, journal);
  EXPECT_EQ(go_on(), 0);
  EXPECT_EQ(bytes_of(file_), whole_);
}

// A disk that takes no more than `bytes` of a file, for as long as this lives.
class SmallDisk {
 public:
  explicit SmallDisk(size_t bytes) {
    getrlimit(RLIMIT_FSIZE, &before_);
    std::signal(SIGXFSZ, SIG_IGN);  // the write fails instead
    const rlimit limit{bytes, before_.rlim_max};
    setrlimit(RLIMIT_FSIZE, &limit);
  }
  ~SmallDisk() {
    setrlimit(RLIMIT_FSIZE, &before_);
    std::signal(SIGXFSZ, SIG_DFL);
  }
  SmallDisk(const SmallDisk&) = delete;
  SmallDisk& operator=(const SmallDisk&) = delete;

 private:
  rlimit before_{};
};

TEST_F(MapDatabaseBuild, ThatFillsTheDiskSaysSoAndGoesOnWhenThereIsRoom) {
  for (size_t room = 0; room < whole_.size(); room += whole_.size() / 20) {
    try {
      const SmallDisk disk(room);
      go_on();
      ADD_FAILURE() << "a map of " << whole_.size() << " bytes was written to " << room;
    } catch (const MapDatabaseError& error) {
      EXPECT_THAT(error.what(), HasSubstr("resumed.onmap"));
      EXPECT_THAT(error.what(), AnyOf(HasSubstr("disk full"), HasSubstr("File too large"))) << room;
    }
    EXPECT_FALSE(std::filesystem::exists(file_)) << "an unfinished build must not look like a map";
  }
  EXPECT_GT(go_on(), 0);
  EXPECT_EQ(bytes_of(file_), whole_);
}

TEST_F(MapDatabaseBuild, DoesNotGoOnWithAnotherMap) {
  build_up_to(2);
  std::vector<MapDescription> other = two_levels();
  other[0].fingerprint = "ffffffffffffffff";
  const MapDatabaseWriter writer(file_, other);
  EXPECT_EQ(writer.num_blocks(), 0);
}

TEST_F(MapDatabaseBuild, WaitsForAnotherProgramThatBuildsTheSame) {
  auto first = std::make_unique<MapDatabaseWriter>(file_, two_levels());
  write_blocks(*first, 0, 1);
  auto second = std::async(std::launch::async, [&] { return MapDatabaseWriter(file_, two_levels()).num_blocks(); });
  EXPECT_EQ(second.wait_for(std::chrono::milliseconds(50)), std::future_status::timeout);
  write_blocks(*first, 2, 2);
  first->finish();
  first.reset();
  // It begins anew, and must not touch what is finished.
  EXPECT_EQ(second.get(), 0);
  EXPECT_EQ(bytes_of(file_), whole_);
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
