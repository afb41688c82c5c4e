// The map's feature database D = {(f_j, l_j)} of equation (3), as a file.
//
// A file of type .onmap holds a header, an index of square tiles and each tile's features one after the other, so
// that a tile is served straight from the memory-mapped file. Format version, sizes and checksums are verified on
// opening: a file of another version, a truncated or a damaged one is an error that says what to do, never a wrong
// map.
#pragma once

#include <cstdint>
#include <filesystem>
#include <fstream>
#include <memory>
#include <span>
#include <stdexcept>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "common/geo/enu_frame.h"
#include "services/map_server/options.h"

namespace orthonav::map_server {

// A database that cannot be used; the message names the file and the remedy.
class MapDatabaseError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

// What the file says of itself; the fields have the meaning of those of map_info_t.
struct MapDescription {
  std::string fingerprint;  // 16 hexadecimal digits: of the raster, the elevation model, the parameters and the format
  Geodetic anchor;          // origin of G: the map's upper-left corner
  double metres_per_pixel = 0;
  double east_min = 0, east_max = 0, north_min = 0, north_max = 0;  // m in G, area of the tiles
  int64_t num_features = 0;
  double keypoint_size = 0;                   // map pixels; 0: chosen by the detector
  double keypoint_stride = 0;                 // map pixels; 0: chosen by the detector
  double tile_size = 0;                       // m
  int tile_columns = 0;                       // west to east
  int tile_rows = 0;                          // south to north
  bool has_surface = false;                   // heights come from an elevation model
  FeatureKind features = FeatureKind::kGrid;  // what the descriptors are

  int num_tiles() const { return tile_columns * tile_rows; }
  // Tile of a position of G, -1 outside the area.
  int tile_of(double east, double north) const;
};

// Features of one tile: east, north, up in G (m) and a SIFT descriptor of 128 bytes each.
struct TileFeatures {
  std::vector<Eigen::Vector3f> positions;
  std::vector<uint8_t> descriptors;  // 128 per position
};

struct TileView {
  std::span<const Eigen::Vector3f> positions;
  std::span<const uint8_t> descriptors;  // 128 per position
};

// Reads a database. Immutable and thread-safe after construction; views live as long as the object.
class MapDatabase {
 public:
  // Throws MapDatabaseError.
  explicit MapDatabase(const std::filesystem::path& file);
  ~MapDatabase();
  MapDatabase(const MapDatabase&) = delete;
  MapDatabase& operator=(const MapDatabase&) = delete;

  const std::filesystem::path& file() const { return file_; }
  const MapDescription& description() const { return description_; }

  // Throws std::out_of_range for a tile that does not exist.
  TileView tile(int index) const;

 private:
  void open();

  std::filesystem::path file_;
  MapDescription description_;
  const std::byte* data_ = nullptr;
  size_t size_ = 0;
};

// Writes a database tile by tile, in any order of tiles. The file takes its name when finish() succeeds; before, it
// has another one beside it, so a build that was broken off leaves nothing that looks like a map.
class MapDatabaseWriter {
 public:
  // `description` with num_features 0. Throws MapDatabaseError when the file cannot be created.
  MapDatabaseWriter(const std::filesystem::path& file, const MapDescription& description);
  ~MapDatabaseWriter();
  MapDatabaseWriter(const MapDatabaseWriter&) = delete;
  MapDatabaseWriter& operator=(const MapDatabaseWriter&) = delete;

  // Each tile at most once; tiles never written are empty.
  void write_tile(int index, const TileFeatures& features);

  // Throws MapDatabaseError when writing failed, for instance on a full disk.
  void finish();

  int64_t num_features() const { return description_.num_features; }

 private:
  struct Entry {
    uint64_t offset = 0;
    uint64_t count = 0;
    uint64_t checksum = 0;
  };

  std::filesystem::path file_;
  std::filesystem::path unfinished_;
  MapDescription description_;
  std::vector<Entry> index_;
  std::ofstream out_;
  uint64_t end_ = 0;
};

// 64-bit FNV-1a over 8-byte words: detects damage and tells inputs apart; no defence against forgery.
class Checksum {
 public:
  void add(const void* data, size_t size);
  void add(const std::string& text) { add(text.data(), text.size()); }
  uint64_t value() const { return value_; }

 private:
  uint64_t value_ = 14695981039346656037ULL;
};

}  // namespace orthonav::map_server
