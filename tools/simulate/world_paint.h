// Draws a layout, as it is in one epoch, into rasters of height and of what covers the ground.
#pragma once

#include <vector>

#include <opencv2/core.hpp>

#include "tools/simulate/world_epoch.h"
#include "tools/simulate/world_layout.h"

namespace orthonav::simulate {

// Smooth bare ground.
class Terrain {
 public:
  // Relief of `rms` m with wavelengths of up to `wavelength` m, over `bounds` and a little more.
  Terrain(const Bounds& bounds, double rms, double wavelength, uint64_t seed);
  // m in G; beyond the bounds the nearest edge's height.
  double height(const Eigen::Vector2d& p) const;

 private:
  static constexpr double kCell = 4.0;
  Eigen::Vector2d origin_;
  cv::Mat height_;
};

// Pixel (u, v) has its centre at east_min + (u + 0.5) resolution, north_max - (v + 0.5) resolution.
struct Canvas {
  double east_min = 0, north_max = 0, resolution = 0.1;  // m
  cv::Mat height;                                        // CV_32F, m in G
  cv::Mat label;                                         // CV_16U, index into materials
  std::vector<Material> materials;

  cv::Size size() const { return height.size(); }
};

Canvas paint(const Layout& layout, const Epoch& epoch, const Terrain& terrain, const Bounds& bounds, double resolution);

}  // namespace orthonav::simulate
