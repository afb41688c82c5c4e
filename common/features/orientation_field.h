// SIFT descriptors at fixed orientation and size, for many points of one image: grids of the map and tracked corners.
//
// A SIFT descriptor is 4 x 4 histograms of gradient directions, each over a square cell with soft edges. With the
// orientation and the size fixed, the histogram of the cell around any place is the same for every descriptor that
// reaches it, so it is computed once: the gradients' magnitudes are split into 8 channels by direction, gathered in
// blocks and smoothed with the cell's triangular window. A descriptor is then read off the channels at 16 places,
// weighted with SIFT's Gaussian window and normalised as RootSIFT, where 0.5 ms a point become microseconds for the
// whole of it; shifting a descriptor by fractions of a pixel costs as little, which is what sub-pixel alignment needs.
//
// Both sides of a comparison choose their pixels: the field is told how wide its image's pixels are and how its image
// lies on the map, and the 16 places may be put through any affine map, so that a tilted camera's image is described
// as the map sees the ground without being resampled.
//
// For a map: OrientationField(grey, {.keypoint_size = size}).describe(points). Pixels without data are to be filled
// first (fill_invalid), and orientation_margin(size) pixels around the points to be given where there are any.
//
// Objects are immutable after construction and may be used from several threads.
#pragma once

#include <cstdint>
#include <vector>

#include <Eigen/Core>
#include <opencv2/core.hpp>

#include "common/features/fixed_sift.h"

namespace orthonav {

// Length that every descriptor with texture has: similarities are dot products of bytes, at most its square.
inline constexpr double kRootSiftLength = 512;

struct OrientationFieldOptions {
  double keypoint_size = 12;  // map pixels, as in FixedSift: the 4 x 4 cells are 1.5 sizes wide each
  double pixel_width = 1;     // map pixels that one pixel of the image is wide
  double rotation = 0;        // rad: turns directions of the image (u right, v down) to those of the map
};

class OrientationField {
 public:
  // `grey` is CV_8U. Throws std::invalid_argument for another type, an empty image, or options out of range
  // (keypoint_size in [2, 128], 0.1 <= pixel_width <= keypoint_size / 3).
  OrientationField(const cv::Mat& grey, const OrientationFieldOptions& options);

  // One descriptor of kSiftBytes. Offset (x, y) of the map, in map pixels from the point (east and south), lies at
  // `centre` + `jacobian` (x, y) in the image. Outside the image there is no gradient. Returns false and zeros when
  // there is no texture to speak of.
  bool describe(const Eigen::Vector2f& centre, const Eigen::Matrix2f& jacobian, uint8_t* out) const;

  // The same for points of a map's own image: CV_8U, a row of kSiftBytes per point, zeros without texture.
  cv::Mat describe(const std::vector<cv::Point2f>& points) const;

 private:
  float cell_;             // width of a histogram's cell, map pixels
  float pixels_per_node_;  // image pixels between the nodes of the field
  cv::Mat nodes_;          // CV_32FC(8): smoothed channels, within a border of one node of zeros
};

// Half the width of the square a descriptor depends on, map pixels.
int orientation_margin(double keypoint_size);

}  // namespace orthonav
