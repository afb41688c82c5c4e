// Square cells over the image, about as many as tracks are wanted: where tracks are missing, and where they crowd.
//
// A camera that climbs, zooms by tilting or spins draws its tracks together. Followed for as long as they can be, 140
// of them came to lie within 1/100 of the image (take-off, 60 m up): a pinhole to the odometry, and one witness of 140
// names to whoever compares them with a map. So tracks are kept apart and empty cells are filled whatever the motion.
// A value; thread-safe once made.
#pragma once

#include <cstddef>
#include <vector>

#include <Eigen/Core>
#include <opencv2/core.hpp>

#include "services/vio/state.h"

namespace orthonav::vio {

class ImageGrid {
 public:
  // `count` cells at least about, of an image of `size` pixels.
  ImageGrid(const cv::Size& size, int count);

  int size() const { return columns_ * rows_; }  // cells
  // Side of a cell, pixels.
  double side() const { return side_; }
  size_t cell_of(const Eigen::Vector2d& pixel) const;
  cv::Rect area(size_t cell) const;
  // Tracks in each cell.
  std::vector<int> occupancy(const std::vector<TrackedFeature>& features) const;

 private:
  cv::Size size_;
  double side_;
  int columns_, rows_;
  double width_, height_;  // pixels, of a cell
};

// Which of the features, in this order, are not within `distance` pixels of one before them that stays.
std::vector<bool> kept_apart(const std::vector<TrackedFeature>& features, double distance);

}  // namespace orthonav::vio
