// The map's feature database D = {(f_j, l_j)} of equation (3), as a file.
//
// A file of type .onmap holds a header, a record for each level, an index of square tiles and each tile's features one
// after the other. Levels are pictures of the same ground at sigma, 2 sigma, 4 sigma, ... with tiles of as many
// pixels each: the finest is level 0.
//
// A file of another version, a truncated or a damaged one is an error that says what to do, never a wrong map: header,
// levels and index are verified on opening, a tile's checksum each time it is read. Opening costs the same for a
// hectare as for 1,000 km2; verify() reads everything.
#pragma once

#include <cstdint>
#include <filesystem>
#include <stdexcept>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "common/geo/enu_frame.h"
#include "services/map_server/checksum.h"
#include "services/map_server/options.h"

namespace orthonav::map_server {

// A database that cannot be used; the message names the file and the remedy.
class MapDatabaseError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

// What the file says of one level; the fields have the meaning of those of map_info_t.
struct MapDescription {
  std::string fingerprint;  // 16 hexadecimal digits: of the raster, elevation model, parameters, format and level
  Geodetic anchor;          // origin of G: the map's upper-left corner, the same for all levels
  double metres_per_pixel = 0;
  double east_min = 0, east_max = 0, north_min = 0, north_max = 0;  // m in G, area of the tiles
  int64_t num_features = 0;
  double keypoint_size = 0;                       // map pixels; 0: chosen by the detector
  double keypoint_stride = 0;                     // map pixels; 0: chosen by the detector
  double tile_size = 0;                           // m
  int tile_columns = 0;                           // west to east
  int tile_rows = 0;                              // south to north
  bool has_surface = false;                       // heights come from an elevation model
  FeatureKind features = FeatureKind::kRootSift;  // what the descriptors are
  int64_t num_without_data = 0;     // interest points left out: no data in the raster or the elevation model
  int64_t num_without_texture = 0;  // interest points left out: nothing to recognise, as on water

  int num_tiles() const { return tile_columns * tile_rows; }
  // Tile of a position of G, -1 outside the area.
  int tile_of(double east, double north) const;
};

// Features of one tile: east, north, up in G (m) and a descriptor of 128 bytes each.
struct TileFeatures {
  std::vector<Eigen::Vector3f> positions;
  std::vector<uint8_t> descriptors;  // 128 per position
};

// Where a tile lies in the file.
struct TileEntry {
  uint64_t offset = 0;
  uint64_t count = 0;  // features
  uint64_t checksum = 0;
};

// Reads a database. Immutable and thread-safe after construction. Tiles are read when asked for, so that a file that is
// cut or overwritten under a running server is an error too.
class MapDatabase {
 public:
  // Throws MapDatabaseError.
  explicit MapDatabase(const std::filesystem::path& file);
  ~MapDatabase();
  MapDatabase(const MapDatabase&) = delete;
  MapDatabase& operator=(const MapDatabase&) = delete;

  const std::filesystem::path& file() const { return file_; }
  const std::vector<MapDescription>& levels() const { return levels_; }
  int64_t num_features() const;  // of all levels

  // Throws std::out_of_range for a level or tile that does not exist, MapDatabaseError for a damaged one.
  TileFeatures tile(int level, int index) const;

  // Features of all tiles of a level, in their order. Throws as tile() does.
  TileFeatures all_tiles(int level) const;

  // Reads every tile. Throws MapDatabaseError naming the first that is damaged.
  void verify() const;

 private:
  void open();
  TileFeatures read(size_t entry) const;

  std::filesystem::path file_;
  int descriptor_ = -1;
  std::vector<MapDescription> levels_;
  std::vector<TileEntry> index_;  // of all levels, the finest first
};

// Reading and writing share this, and nobody else needs it.
namespace onmap {

inline constexpr int kDescriptorBytes = 128;
inline constexpr size_t kFeatureBytes = sizeof(Eigen::Vector3f) + kDescriptorBytes;
inline constexpr int64_t kMaxTiles = 100'000'000;
inline constexpr size_t kMaxLevels = 16;

// Header, levels and index as they stand at the beginning of the file.
std::string head_of(const std::vector<MapDescription>& levels, const std::vector<TileEntry>& index,
                    uint64_t file_bytes);
size_t head_bytes(const std::vector<MapDescription>& levels);
std::string pack(const TileFeatures& features);
uint64_t checksum_of(const void* data, size_t size);

}  // namespace onmap

}  // namespace orthonav::map_server
