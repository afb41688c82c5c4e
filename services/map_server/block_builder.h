// Describes one rectangle of a map's tiles at a time, in memory that does not depend on the size of the raster.
//
// The raster, in whatever coordinate system, is first resampled to pixels of sigma metres that are aligned with east
// and north of G. Interest points, descriptors and positions are then those of G itself, the same from a UTM, a
// Web Mercator or a WGS84 raster: grid north is not true north, and degrees are not square.
//
// Pixel (i, j) of that picture has its centre at east = (i + 0.5) sigma, north = -(j + 0.5) sigma, G's origin being the
// raster's upper-left corner (the outer corner of its first pixel). So for a raster that is north-up already, these are
// the raster's own pixels.
#pragma once

#include <filesystem>
#include <optional>
#include <vector>

#include <Eigen/Core>
#include <opencv2/core.hpp>

#include "common/features/fixed_sift.h"
#include "common/geo/enu_frame.h"
#include "common/geo/raster.h"
#include "services/map_server/ground_surface.h"
#include "services/map_server/map_database_writer.h"
#include "services/map_server/options.h"

namespace orthonav::map_server {

// Elevation model that the options mean for this raster.
std::optional<std::filesystem::path> elevation_model(const std::filesystem::path& raster, const BuildOptions& options);

// A rectangle of tiles of a level that is resampled and described at once.
struct Block {
  int level = 0;
  cv::Rect tiles;  // column and row of tiles
};

struct BlockFeatures {
  std::vector<NumberedTile> tiles;
  int level = 0;
  int64_t without_data = 0;
  int64_t without_texture = 0;
};

// Not thread-safe: one object per thread.
class BlockBuilder {
 public:
  // Throws std::runtime_error naming the file (no raster, no georeference, no elevations).
  BlockBuilder(const std::filesystem::path& raster, const BuildOptions& options);

  // Without fingerprints and counts.
  const std::vector<MapDescription>& levels() const { return levels_; }

  // All blocks, in the order in which they are written.
  std::vector<Block> blocks() const;

  BlockFeatures build(const Block& block);

 private:
  struct Picture {
    int level = 0;
    int i0 = 0, j0 = 0;  // pixel of G's picture at the upper-left of `grey`
    cv::Mat grey;
    cv::Mat valid;
  };

  static GroundSurface make_surface(const Raster& raster, const BuildOptions& options);
  MapDescription describe_level(int level) const;
  Picture resample(const Block& block);
  std::vector<cv::Point2f> interest_points(const Picture& picture, const Block& block, BlockFeatures& result) const;
  Eigen::Vector2d position(int level, double i, double j) const;
  int tile_in(const Block& block, const Eigen::Vector2d& en) const;

  BuildOptions options_;
  Raster raster_;
  GroundSurface surface_;
  EnuFrame frame_;
  FixedSift sift_;
  double own_metres_per_pixel_ = 0;  // of the raster
  std::vector<MapDescription> levels_;
};

}  // namespace orthonav::map_server
