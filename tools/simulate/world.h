// The simulated world: a lit surface for the camera, and the map that was made of it at another date.
#pragma once

#include <cstdint>
#include <filesystem>
#include <functional>
#include <string>

#include <Eigen/Core>
#include <opencv2/core.hpp>

#include "common/geo/enu_frame.h"

namespace orthonav {
class ConfigNode;
}

namespace orthonav::simulate {

// What the camera sees: a height field with its luminance, on a square grid aligned with east and north of G.
// Row 0 is the northern edge. Pixel (u, v) has its centre at
//   east = east_min + (u + 0.5) resolution,  north = north_max - (v + 0.5) resolution.
struct Surface {
  double east_min = 0;    // m in G
  double north_max = 0;   // m in G
  double resolution = 0;  // m per pixel
  cv::Mat height;         // CV_32F, m in G (z up), buildings and trees included
  cv::Mat luminance;      // CV_8U, as lit and shadowed in the camera's epoch, before any camera effect
};

struct World {
  EnuFrame frame;   // G: anchored at the map's upper-left corner, z = 0 at anchor().height
  Surface surface;  // covers the map and a margin around it
  // Bounds of the map, m in G: the flight stays inside them.
  double map_east_min = 0, map_east_max = 0, map_north_min = 0, map_north_max = 0;
  double ground_height = 0;  // m in G, mean of the bare ground: flight heights are above this
  // Georeferencing error of the map: where the map shows a ground point minus where it is, m (east, north).
  std::function<Eigen::Vector2d(const Eigen::Vector2d& p_en)> map_offset;
};

// Builds the world that `world` (the `world:` part of simulate.yaml) describes and writes the map's GeoTIFF, and
// beside it (suffix .dem.tif) a coarse elevation model of the bare ground, ellipsoidal heights, as public ones are.
// `difference` names the preset of what changed between the epochs ("season", "years"). The camera's epoch and the
// terrain depend on `seed` alone, so one flight can be navigated by maps of several differences.
// An empty `map_file` writes no map. Throws ConfigError, or std::runtime_error naming a file.
World make_world(ConfigNode& world, uint64_t seed, const std::string& difference,
                 const std::filesystem::path& map_file);

}  // namespace orthonav::simulate
