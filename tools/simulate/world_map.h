// The map as it is handed over: an orthophoto of an epoch through its makers' camera, processing and errors, in a
// coordinate system of its own; and the coarse elevation model that anyone can get.
#pragma once

#include <filesystem>
#include <functional>
#include <string>
#include <vector>

#include <Eigen/Core>
#include <opencv2/core.hpp>

#include "common/geo/enu_frame.h"
#include "tools/simulate/world_layout.h"

namespace orthonav::simulate {

struct MapOptions {
  std::string crs = "EPSG:32633";
  double resolution = 0.3;       // m/px
  bool colour = true;            // RGB, else grey
  int jpeg_quality = 85;         // 0: stored without loss
  double offset_rms = 0.5;       // m: bias and warp of the georeference together
  double bias_share = 0.5;       // share of the bias in the variance of the offset
  double warp_wavelength = 300;  // m
  double dem_resolution = 30;    // m
  double dem_error_rms = 1.0;    // m, smooth
};

// The sensor and processing that made the map; belongs to the difference between the epochs.
struct MapSensor {
  double blur = 0.20;            // m, standard deviation of the optics' spread
  double lean_deg = 3.0;         // how far from the vertical it looks, rms: tops of things are shifted
  double lean_wavelength = 150;  // m, between views of different photographs; 0: one view everywhere
  double gamma = 1.0;
  double contrast = 1.0;    // about the mean
  double brightness = 0;    // grey levels
  double tint = 0.03;       // relative gain error between the colours
  double noise = 2.0;       // grey levels, per map pixel
  double sharpening = 0.0;  // unsharp mask at one map pixel
};

// Georeferencing error: where the map shows a point minus where it is, as a function of where it is.
using MapOffset = std::function<Eigen::Vector2d(const Eigen::Vector2d& p_en)>;
// Its rms over the area is options.offset_rms exactly.
MapOffset make_map_offset(const MapOptions& options, const Bounds& area, uint64_t seed);

// What the map's makers photographed: an image and surface heights on one grid (row 0 in the north, centres at
// east_min + (u + 0.5) resolution, north_max - (v + 0.5) resolution).
struct Scene {
  double east_min = 0, north_max = 0, resolution = 0;  // m in G, m/px
  cv::Mat image;                                       // CV_8U or CV_8UC3
  cv::Mat above_ground;                                // CV_32F, m; empty: nothing leans
};

// Writes the orthophoto, whose upper-left corner is the anchor of `frame` and which spans `width` x `height` m.
// Throws std::runtime_error naming the file, or the coordinate system when GDAL does not know it.
void write_map(const std::filesystem::path& file, const MapOptions& options, const MapSensor& sensor,
               const EnuFrame& frame, double width, double height, const Scene& scene, const MapOffset& offset,
               uint64_t seed);

// Writes the elevation model: CV_32F GeoTIFF of ellipsoidal heights in geographic coordinates. `ground` gives
// z in G of the bare ground.
void write_dem(const std::filesystem::path& file, const MapOptions& options, const EnuFrame& frame, const Bounds& area,
               const std::function<double(const Eigen::Vector2d&)>& ground, uint64_t seed);

// Bounds in G of a map of the given size: the largest axis-parallel rectangle inside it.
Bounds map_bounds(const MapOptions& options, const EnuFrame& frame, double width, double height);

// A rectangle given in the map's coordinate system.
struct MapArea {
  Geodetic corner;       // upper left, at the given ellipsoidal height
  double width, height;  // m on the ground
};
// `area`: west, south, east, north in options.crs. Throws std::runtime_error as write_map does.
MapArea map_area(const MapOptions& options, const std::vector<double>& area, double ellipsoidal_height);

}  // namespace orthonav::simulate
