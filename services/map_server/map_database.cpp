#include "services/map_server/map_database.h"

#include <algorithm>
#include <array>
#include <bit>
#include <cerrno>
#include <cmath>
#include <cstddef>
#include <system_error>

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/stat.h>
#include <unistd.h>

namespace orthonav::map_server {
namespace {

static_assert(std::endian::native == std::endian::little, "the .onmap format is little-endian");
static_assert(sizeof(Eigen::Vector3f) == 3 * sizeof(float));

constexpr std::array<char, 8> kMagic = {'O', 'N', 'M', 'A', 'P', '\r', '\n', '\x1a'};
constexpr uint32_t kVersion = 3;

// All members are naturally aligned: no padding to leave undefined.
struct Header {
  std::array<char, 8> magic;
  uint32_t version;
  uint32_t header_bytes;
  uint64_t file_bytes;
  double anchor_latitude_deg, anchor_longitude_deg, anchor_height;
  int32_t num_levels;
  int32_t descriptor_bytes;
  uint64_t levels_checksum;
  uint64_t index_checksum;
  uint64_t header_checksum;  // of all members before
};
static_assert(std::is_trivially_copyable_v<Header> && sizeof(Header) == 80);

struct LevelRecord {
  std::array<char, 16> fingerprint;
  double metres_per_pixel;
  double east_min, east_max, north_min, north_max;
  double keypoint_size, keypoint_stride, tile_size;
  int64_t num_features, num_without_data, num_without_texture;
  int32_t tile_columns, tile_rows;
  int32_t has_surface;
  int32_t features;  // a FeatureKind
};
static_assert(std::is_trivially_copyable_v<LevelRecord> && sizeof(LevelRecord) == 120);
static_assert(std::is_trivially_copyable_v<TileEntry> && sizeof(TileEntry) == 24);

uint64_t header_checksum(const Header& header) {
  return onmap::checksum_of(&header, offsetof(Header, header_checksum));
}

LevelRecord record_of(const MapDescription& level) {
  LevelRecord record{};
  std::copy(level.fingerprint.begin(), level.fingerprint.end(), record.fingerprint.begin());
  record.metres_per_pixel = level.metres_per_pixel;
  record.east_min = level.east_min;
  record.east_max = level.east_max;
  record.north_min = level.north_min;
  record.north_max = level.north_max;
  record.keypoint_size = level.keypoint_size;
  record.keypoint_stride = level.keypoint_stride;
  record.tile_size = level.tile_size;
  record.num_features = level.num_features;
  record.num_without_data = level.num_without_data;
  record.num_without_texture = level.num_without_texture;
  record.tile_columns = level.tile_columns;
  record.tile_rows = level.tile_rows;
  record.has_surface = level.has_surface ? 1 : 0;
  record.features = static_cast<int32_t>(level.features);
  return record;
}

MapDescription level_of(const LevelRecord& record, const Header& header) {
  MapDescription level;
  level.fingerprint.assign(record.fingerprint.begin(), record.fingerprint.end());
  level.anchor = {header.anchor_latitude_deg, header.anchor_longitude_deg, header.anchor_height};
  level.metres_per_pixel = record.metres_per_pixel;
  level.east_min = record.east_min;
  level.east_max = record.east_max;
  level.north_min = record.north_min;
  level.north_max = record.north_max;
  level.keypoint_size = record.keypoint_size;
  level.keypoint_stride = record.keypoint_stride;
  level.tile_size = record.tile_size;
  level.num_features = record.num_features;
  level.num_without_data = record.num_without_data;
  level.num_without_texture = record.num_without_texture;
  level.tile_columns = record.tile_columns;
  level.tile_rows = record.tile_rows;
  level.has_surface = record.has_surface != 0;
  level.features = static_cast<FeatureKind>(record.features);
  return level;
}

[[noreturn]] void damaged(const std::filesystem::path& file, const std::string& what) {
  throw MapDatabaseError(
      fmt::format("map database {} is {}: build it again with orthonav-build-map", file.string(), what));
}

// False when the file ends before `size` bytes or cannot be read.
bool read_at(int descriptor, uint64_t offset, void* data, size_t size) {
  auto* out = static_cast<char*>(data);
  while (size > 0) {
    const ssize_t got = ::pread(descriptor, out, size, static_cast<off_t>(offset));
    if (got < 0 && errno == EINTR) continue;
    if (got <= 0) return false;
    out += got;
    offset += static_cast<uint64_t>(got);
    size -= static_cast<size_t>(got);
  }
  return true;
}

}  // namespace

namespace onmap {

uint64_t checksum_of(const void* data, size_t size) {
  Checksum checksum;
  checksum.add(data, size);
  return checksum.value();
}

size_t head_bytes(const std::vector<MapDescription>& levels) {
  size_t bytes = sizeof(Header) + levels.size() * sizeof(LevelRecord);
  for (const MapDescription& level : levels) bytes += static_cast<size_t>(level.num_tiles()) * sizeof(TileEntry);
  return bytes;
}

std::string head_of(const std::vector<MapDescription>& levels, const std::vector<TileEntry>& index,
                    uint64_t file_bytes) {
  std::vector<LevelRecord> records;
  records.reserve(levels.size());
  for (const MapDescription& level : levels) records.push_back(record_of(level));
  const Geodetic& anchor = levels.front().anchor;
  Header header{};
  header.magic = kMagic;
  header.version = kVersion;
  header.header_bytes = sizeof(Header);
  header.file_bytes = file_bytes;
  header.anchor_latitude_deg = anchor.latitude_deg;
  header.anchor_longitude_deg = anchor.longitude_deg;
  header.anchor_height = anchor.height;
  header.num_levels = static_cast<int32_t>(levels.size());
  header.descriptor_bytes = kDescriptorBytes;
  header.levels_checksum = checksum_of(records.data(), records.size() * sizeof(LevelRecord));
  header.index_checksum = checksum_of(index.data(), index.size() * sizeof(TileEntry));
  header.header_checksum = header_checksum(header);
  std::string head;
  head.append(reinterpret_cast<const char*>(&header), sizeof(header));
  head.append(reinterpret_cast<const char*>(records.data()), records.size() * sizeof(LevelRecord));
  head.append(reinterpret_cast<const char*>(index.data()), index.size() * sizeof(TileEntry));
  return head;
}

std::string pack(const TileFeatures& features) {
  if (features.descriptors.size() != features.positions.size() * kDescriptorBytes) {
    throw std::logic_error("positions and descriptors differ in number");
  }
  std::string bytes;
  bytes.reserve(features.positions.size() * kFeatureBytes);
  bytes.append(reinterpret_cast<const char*>(features.positions.data()),
               features.positions.size() * sizeof(Eigen::Vector3f));
  bytes.append(reinterpret_cast<const char*>(features.descriptors.data()), features.descriptors.size());
  return bytes;
}

}  // namespace onmap

int MapDescription::tile_of(double east, double north) const {
  const double column = std::floor((east - east_min) / tile_size);
  const double row = std::floor((north - north_min) / tile_size);
  if (!(column >= 0 && column < tile_columns && row >= 0 && row < tile_rows)) return -1;
  return static_cast<int>(row) * tile_columns + static_cast<int>(column);
}

MapDatabase::MapDatabase(const std::filesystem::path& file) : file_(file) {
  descriptor_ = ::open(file.c_str(), O_RDONLY | O_CLOEXEC);
  if (descriptor_ < 0) {
    throw MapDatabaseError(
        fmt::format("cannot open map database {}: {}", file.string(), std::generic_category().message(errno)));
  }
  try {
    open();
  } catch (...) {
    ::close(descriptor_);
    throw;
  }
}

void MapDatabase::open() {
  struct stat status {};
  const uint64_t size = ::fstat(descriptor_, &status) == 0 ? static_cast<uint64_t>(status.st_size) : 0;
  Header header{};
  if (size < sizeof(Header) || !read_at(descriptor_, 0, &header, sizeof(header))) {
    damaged(file_, "no map database, or truncated");
  }
  if (header.magic != kMagic) damaged(file_, "no map database (.onmap)");
  if (header.version != kVersion) {
    damaged(file_, fmt::format("of format version {}, this program reads version {}", header.version, kVersion));
  }
  if (header.header_checksum != header_checksum(header) || header.header_bytes != sizeof(Header) ||
      header.descriptor_bytes != onmap::kDescriptorBytes || header.num_levels < 1 ||
      header.num_levels > static_cast<int32_t>(onmap::kMaxLevels)) {
    damaged(file_, "damaged (header)");
  }
  if (header.file_bytes != size) damaged(file_, fmt::format("truncated ({} of {} bytes)", size, header.file_bytes));

  std::vector<LevelRecord> records(static_cast<size_t>(header.num_levels));
  const size_t record_bytes = records.size() * sizeof(LevelRecord);
  if (!read_at(descriptor_, sizeof(Header), records.data(), record_bytes) ||
      onmap::checksum_of(records.data(), record_bytes) != header.levels_checksum) {
    damaged(file_, "damaged (levels)");
  }
  int64_t num_tiles = 0;
  for (const LevelRecord& record : records) {
    num_tiles += static_cast<int64_t>(record.tile_columns) * record.tile_rows;
    if (record.tile_columns < 0 || record.tile_rows < 0 || num_tiles > onmap::kMaxTiles || record.features < 0 ||
        record.features > static_cast<int32_t>(FeatureKind::kRootSift)) {
      damaged(file_, "damaged (tiles)");
    }
    levels_.push_back(level_of(record, header));
  }
  if (onmap::head_bytes(levels_) > size) damaged(file_, "damaged (tiles)");
  index_.resize(static_cast<size_t>(num_tiles));
  const size_t index_bytes = index_.size() * sizeof(TileEntry);
  if (!read_at(descriptor_, sizeof(Header) + record_bytes, index_.data(), index_bytes) ||
      onmap::checksum_of(index_.data(), index_bytes) != header.index_checksum) {
    damaged(file_, "damaged (index)");
  }
  size_t next = 0;
  for (const MapDescription& level : levels_) {
    uint64_t num_features = 0;
    for (int i = 0; i < level.num_tiles(); ++i, ++next) {
      const TileEntry& entry = index_[next];
      if (entry.count > size / onmap::kFeatureBytes || entry.offset > size - entry.count * onmap::kFeatureBytes) {
        damaged(file_, fmt::format("damaged (tile {})", i));
      }
      num_features += entry.count;
    }
    if (num_features != static_cast<uint64_t>(level.num_features)) damaged(file_, "damaged (number of features)");
  }
}

MapDatabase::~MapDatabase() {
  ::close(descriptor_);
}

int64_t MapDatabase::num_features() const {
  int64_t sum = 0;
  for (const MapDescription& level : levels_) sum += level.num_features;
  return sum;
}

TileFeatures MapDatabase::read(size_t entry) const {
  const TileEntry& place = index_[entry];
  std::vector<uint8_t> bytes(place.count * onmap::kFeatureBytes);
  if (!read_at(descriptor_, place.offset, bytes.data(), bytes.size()) ||
      onmap::checksum_of(bytes.data(), bytes.size()) != place.checksum) {
    damaged(file_, fmt::format("damaged (tile {})", entry));
  }
  TileFeatures tile;
  tile.positions.resize(place.count);
  const size_t position_bytes = place.count * sizeof(Eigen::Vector3f);
  std::copy_n(bytes.data(), position_bytes, reinterpret_cast<uint8_t*>(tile.positions.data()));
  tile.descriptors.assign(bytes.begin() + static_cast<std::ptrdiff_t>(position_bytes), bytes.end());
  return tile;
}

TileFeatures MapDatabase::tile(int level, int index) const {
  if (level < 0 || level >= static_cast<int>(levels_.size()) || index < 0 ||
      index >= levels_[static_cast<size_t>(level)].num_tiles()) {
    throw std::out_of_range(fmt::format("no tile {} of level {}", index, level));
  }
  auto entry = static_cast<size_t>(index);
  for (int i = 0; i < level; ++i) entry += static_cast<size_t>(levels_[static_cast<size_t>(i)].num_tiles());
  return read(entry);
}

TileFeatures MapDatabase::all_tiles(int level) const {
  TileFeatures all;
  const MapDescription& description = levels_.at(static_cast<size_t>(level));
  all.positions.reserve(static_cast<size_t>(description.num_features));
  all.descriptors.reserve(static_cast<size_t>(description.num_features) * onmap::kDescriptorBytes);
  for (int i = 0; i < description.num_tiles(); ++i) {
    const TileFeatures one = tile(level, i);
    all.positions.insert(all.positions.end(), one.positions.begin(), one.positions.end());
    all.descriptors.insert(all.descriptors.end(), one.descriptors.begin(), one.descriptors.end());
  }
  return all;
}

void MapDatabase::verify() const {
  for (size_t i = 0; i < index_.size(); ++i) (void)read(i);
}

}  // namespace orthonav::map_server
