#include "services/map_server/map_database.h"

#include <algorithm>
#include <array>
#include <bit>
#include <cerrno>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <random>
#include <system_error>

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

namespace orthonav::map_server {
namespace {

static_assert(std::endian::native == std::endian::little, "the .onmap format is little-endian");
static_assert(sizeof(Eigen::Vector3f) == 3 * sizeof(float));

constexpr std::array<char, 8> kMagic = {'O', 'N', 'M', 'A', 'P', '\r', '\n', '\x1a'};
constexpr uint32_t kVersion = 2;
constexpr int kDescriptorBytes = 128;
constexpr size_t kFeatureBytes = sizeof(Eigen::Vector3f) + kDescriptorBytes;
constexpr int kMaxTiles = 100'000'000;

// All members are naturally aligned: no padding to leave undefined.
struct Header {
  std::array<char, 8> magic;
  uint32_t version;
  uint32_t header_bytes;
  uint64_t file_bytes;
  std::array<char, 16> fingerprint;
  double anchor_latitude_deg, anchor_longitude_deg, anchor_height;
  double metres_per_pixel;
  double east_min, east_max, north_min, north_max;
  double keypoint_size, keypoint_stride, tile_size;
  int64_t num_features;
  int32_t tile_columns, tile_rows;
  int32_t descriptor_bytes;
  int32_t has_surface;
  int32_t features;  // a FeatureKind
  int32_t unused;
  uint64_t index_checksum;
  uint64_t header_checksum;  // of all members before
};
static_assert(std::is_trivially_copyable_v<Header> && sizeof(Header) == 176);

struct IndexEntry {
  uint64_t offset;
  uint64_t count;
  uint64_t checksum;
};

uint64_t checksum_of(const void* data, size_t size) {
  Checksum checksum;
  checksum.add(data, size);
  return checksum.value();
}

uint64_t header_checksum(const Header& header) {
  return checksum_of(&header, offsetof(Header, header_checksum));
}

[[noreturn]] void damaged(const std::filesystem::path& file, const std::string& what) {
  throw MapDatabaseError(
      fmt::format("map database {} is {}: build it again with orthonav-build-map", file.string(), what));
}

}  // namespace

void Checksum::add(const void* data, size_t size) {
  constexpr uint64_t kPrime = 1099511628211ULL;
  const auto* bytes = static_cast<const unsigned char*>(data);
  while (size >= 8) {
    uint64_t word = 0;
    std::memcpy(&word, bytes, 8);
    value_ = (value_ ^ word) * kPrime;
    // The multiplication moves information upwards only: bring it down again.
    value_ ^= value_ >> 32;
    bytes += 8;
    size -= 8;
  }
  for (; size > 0; --size, ++bytes) value_ = (value_ ^ *bytes) * kPrime;
}

int MapDescription::tile_of(double east, double north) const {
  const double column = std::floor((east - east_min) / tile_size);
  const double row = std::floor((north - north_min) / tile_size);
  if (!(column >= 0 && column < tile_columns && row >= 0 && row < tile_rows)) return -1;
  return static_cast<int>(row) * tile_columns + static_cast<int>(column);
}

MapDatabase::MapDatabase(const std::filesystem::path& file) : file_(file) {
  const int descriptor = ::open(file.c_str(), O_RDONLY | O_CLOEXEC);
  if (descriptor < 0) {
    throw MapDatabaseError(
        fmt::format("cannot open map database {}: {}", file.string(), std::generic_category().message(errno)));
  }
  struct stat status {};
  const bool known = ::fstat(descriptor, &status) == 0;
  size_ = known ? static_cast<size_t>(status.st_size) : 0;
  if (size_ < sizeof(Header)) {
    ::close(descriptor);
    damaged(file_, "no map database, or truncated");
  }
  void* mapped = ::mmap(nullptr, size_, PROT_READ, MAP_PRIVATE, descriptor, 0);
  ::close(descriptor);
  if (mapped == MAP_FAILED) {  // NOLINT(performance-no-int-to-ptr)
    throw MapDatabaseError(
        fmt::format("cannot map {} into memory: {}", file.string(), std::generic_category().message(errno)));
  }
  data_ = static_cast<const std::byte*>(mapped);
  try {
    open();
  } catch (...) {
    ::munmap(mapped, size_);
    throw;
  }
}

void MapDatabase::open() {
  Header header{};
  std::memcpy(&header, data_, sizeof(header));
  if (header.magic != kMagic) damaged(file_, "no map database (.onmap)");
  if (header.version != kVersion) {
    damaged(file_, fmt::format("of format version {}, this program reads version {}", header.version, kVersion));
  }
  if (header.header_checksum != header_checksum(header) || header.header_bytes != sizeof(Header) ||
      header.descriptor_bytes != kDescriptorBytes || header.features < 0 ||
      header.features > static_cast<int32_t>(FeatureKind::kRootSift)) {
    damaged(file_, "damaged (header)");
  }
  if (header.file_bytes != size_) {
    damaged(file_, fmt::format("truncated ({} of {} bytes)", size_, header.file_bytes));
  }
  const int64_t num_tiles = static_cast<int64_t>(header.tile_columns) * header.tile_rows;
  if (num_tiles < 0 || num_tiles > kMaxTiles ||
      sizeof(Header) + static_cast<uint64_t>(num_tiles) * sizeof(IndexEntry) > size_) {
    damaged(file_, "damaged (tiles)");
  }
  const auto* index = data_ + sizeof(Header);
  if (checksum_of(index, static_cast<size_t>(num_tiles) * sizeof(IndexEntry)) != header.index_checksum) {
    damaged(file_, "damaged (index)");
  }
  uint64_t num_features = 0;
  for (int64_t tile = 0; tile < num_tiles; ++tile) {
    IndexEntry entry{};
    std::memcpy(&entry, index + static_cast<size_t>(tile) * sizeof(IndexEntry), sizeof(entry));
    if (entry.count > size_ / kFeatureBytes || entry.offset > size_ - entry.count * kFeatureBytes ||
        entry.offset % alignof(Eigen::Vector3f) != 0 ||
        checksum_of(data_ + entry.offset, entry.count * kFeatureBytes) != entry.checksum) {
      damaged(file_, fmt::format("damaged (tile {})", tile));
    }
    num_features += entry.count;
  }
  if (num_features != static_cast<uint64_t>(header.num_features)) damaged(file_, "damaged (number of features)");

  description_.fingerprint.assign(header.fingerprint.begin(), header.fingerprint.end());
  description_.anchor = {header.anchor_latitude_deg, header.anchor_longitude_deg, header.anchor_height};
  description_.metres_per_pixel = header.metres_per_pixel;
  description_.east_min = header.east_min;
  description_.east_max = header.east_max;
  description_.north_min = header.north_min;
  description_.north_max = header.north_max;
  description_.num_features = header.num_features;
  description_.keypoint_size = header.keypoint_size;
  description_.keypoint_stride = header.keypoint_stride;
  description_.tile_size = header.tile_size;
  description_.tile_columns = header.tile_columns;
  description_.tile_rows = header.tile_rows;
  description_.has_surface = header.has_surface != 0;
  description_.features = static_cast<FeatureKind>(header.features);
}

MapDatabase::~MapDatabase() {
  ::munmap(const_cast<std::byte*>(data_), size_);  // NOLINT: munmap's signature
}

TileView MapDatabase::tile(int index) const {
  if (index < 0 || index >= description_.num_tiles()) {
    throw std::out_of_range(fmt::format("tile {} of {}", index, description_.num_tiles()));
  }
  IndexEntry entry{};
  std::memcpy(&entry, data_ + sizeof(Header) + static_cast<size_t>(index) * sizeof(IndexEntry), sizeof(entry));
  const auto* positions = reinterpret_cast<const Eigen::Vector3f*>(data_ + entry.offset);
  const auto* descriptors =
      reinterpret_cast<const uint8_t*>(data_ + entry.offset + entry.count * sizeof(Eigen::Vector3f));
  return {{positions, entry.count}, {descriptors, entry.count * kDescriptorBytes}};
}

MapDatabaseWriter::MapDatabaseWriter(const std::filesystem::path& file, const MapDescription& description)
    : file_(file), description_(description), index_(static_cast<size_t>(description.num_tiles())) {
  if (description.fingerprint.size() != 16) throw std::logic_error("a fingerprint has 16 digits");
  if (static_cast<int64_t>(description.tile_columns) * description.tile_rows > kMaxTiles) {
    throw MapDatabaseError(
        fmt::format("{} x {} tiles are too many: raise tile_size_m", description.tile_columns, description.tile_rows));
  }
  description_.num_features = 0;
  // Two programs may build the same file at once: each under a name of its own, and the last rename wins.
  unfinished_ = file.string() + fmt::format(".{:08x}.unfinished", std::random_device{}());
  out_.open(unfinished_, std::ios::binary | std::ios::trunc);
  if (!out_) {
    throw MapDatabaseError(
        fmt::format("cannot create map database {}: {}", file.string(), std::generic_category().message(errno)));
  }
  end_ = sizeof(Header) + index_.size() * sizeof(IndexEntry);
  const std::vector<char> room(static_cast<size_t>(end_), 0);
  out_.write(room.data(), static_cast<std::streamsize>(room.size()));
}

MapDatabaseWriter::~MapDatabaseWriter() {
  if (unfinished_.empty()) return;
  out_.close();
  std::error_code ignored;
  std::filesystem::remove(unfinished_, ignored);
}

void MapDatabaseWriter::write_tile(int index, const TileFeatures& features) {
  Entry& entry = index_.at(static_cast<size_t>(index));
  if (entry.offset != 0) throw std::logic_error("tile written twice");
  if (features.descriptors.size() != features.positions.size() * kDescriptorBytes) {
    throw std::logic_error("positions and descriptors differ in number");
  }
  std::vector<char> block(features.positions.size() * kFeatureBytes);
  const size_t position_bytes = features.positions.size() * sizeof(Eigen::Vector3f);
  std::copy_n(reinterpret_cast<const char*>(features.positions.data()), position_bytes, block.data());
  std::copy(features.descriptors.begin(), features.descriptors.end(),
            block.begin() + static_cast<std::ptrdiff_t>(position_bytes));
  entry = {end_, features.positions.size(), checksum_of(block.data(), block.size())};
  out_.write(block.data(), static_cast<std::streamsize>(block.size()));
  end_ += block.size();
  description_.num_features += static_cast<int64_t>(features.positions.size());
}

void MapDatabaseWriter::finish() {
  for (Entry& entry : index_) {
    if (entry.offset == 0) entry = {sizeof(Header), 0, checksum_of(nullptr, 0)};
  }
  std::vector<IndexEntry> index;
  for (const Entry& entry : index_) index.push_back({entry.offset, entry.count, entry.checksum});
  Header header{};
  header.magic = kMagic;
  header.version = kVersion;
  header.header_bytes = sizeof(Header);
  header.file_bytes = end_;
  std::copy(description_.fingerprint.begin(), description_.fingerprint.end(), header.fingerprint.begin());
  header.anchor_latitude_deg = description_.anchor.latitude_deg;
  header.anchor_longitude_deg = description_.anchor.longitude_deg;
  header.anchor_height = description_.anchor.height;
  header.metres_per_pixel = description_.metres_per_pixel;
  header.east_min = description_.east_min;
  header.east_max = description_.east_max;
  header.north_min = description_.north_min;
  header.north_max = description_.north_max;
  header.keypoint_size = description_.keypoint_size;
  header.keypoint_stride = description_.keypoint_stride;
  header.tile_size = description_.tile_size;
  header.num_features = description_.num_features;
  header.tile_columns = description_.tile_columns;
  header.tile_rows = description_.tile_rows;
  header.descriptor_bytes = kDescriptorBytes;
  header.has_surface = description_.has_surface ? 1 : 0;
  header.features = static_cast<int32_t>(description_.features);
  header.index_checksum = checksum_of(index.data(), index.size() * sizeof(IndexEntry));
  header.header_checksum = header_checksum(header);
  out_.seekp(0);
  out_.write(reinterpret_cast<const char*>(&header), sizeof(header));
  out_.write(reinterpret_cast<const char*>(index.data()),
             static_cast<std::streamsize>(index.size() * sizeof(IndexEntry)));
  out_.close();
  if (!out_) throw MapDatabaseError(fmt::format("cannot write map database {}: is the disk full?", file_.string()));
  std::error_code error;
  std::filesystem::rename(unfinished_, file_, error);
  if (error) {
    throw MapDatabaseError(fmt::format("cannot write map database {}: {}", file_.string(), error.message()));
  }
  unfinished_.clear();
}

}  // namespace orthonav::map_server
