// Parameters of the map and of its server: map_server.yaml.
#pragma once

#include <filesystem>
#include <string>

#include "common/config/config.h"

namespace orthonav::map_server {

enum class FeatureKind {
  kGrid,      // interest points on a grid, OpenCV's SIFT at fixed orientation and size: methods "paper" and "m1"
  kSift,      // the SIFT detector's own keypoints: method "m2"
  kRootSift,  // interest points on a grid, described by an OrientationField: method "submap"
};
const char* name_of(FeatureKind kind);  // as in map_server.yaml

struct BuildOptions {
  FeatureKind features = FeatureKind::kRootSift;
  double keypoint_stride = 10;         // map pixels between interest points
  double keypoint_size = 12;           // map pixels, see FixedSift
  double metres_per_pixel = 0;         // sigma; 0: the raster's own, at its centre
  double tile_size_m = 45;             // side of a tile
  double max_invalid_fraction = 0.25;  // of a descriptor's square; above, the point is left out
  double min_contrast = 2;             // grey levels of 255, rms in a descriptor's square; below, the point is left out
  int levels = 1;                      // resolutions: sigma, 2 sigma, 4 sigma, ...
  double ground_height_m = 0;  // above the ellipsoid: height of the flat ground where there is no elevation model
  // Elevation model, any raster of ellipsoidal ground heights: "none", "auto" (the raster's name with .dem.tif for
  // its ending, when there is such a file beside it) or a file.
  std::string dem = "auto";

  // Reads map_server.yaml's `map:`. Throws ConfigError.
  static BuildOptions from_config(ConfigNode& node);
};

struct ServerOptions {
  BuildOptions build;
  std::filesystem::path file;  // raster or .onmap
  int part_period_us = 1000;   // between batches of parts
  int parts_per_period = 24;   // parts of at most 1400 bytes in a batch

  // Reads map_server.yaml. Throws ConfigError.
  static ServerOptions from_config(const std::filesystem::path& config_folder);
};

}  // namespace orthonav::map_server
