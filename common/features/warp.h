// Resampling an image by a smooth mapping, as both the map (to north-up ENU pixels) and the query image (to the map's
// heading and scale) need it, so that both reach SIFT with the same blur.
#pragma once

#include <functional>

#include <Eigen/Core>
#include <opencv2/core.hpp>

namespace orthonav {

struct WarpGrid {
  cv::Size size;  // of the output, pixels
  int step = 16;  // output pixels between the nodes at which the mapping is evaluated; bilinear between them
};

// The mapping at the grid's nodes, CV_64FC2: `source_of` gives the source pixel of an output pixel.
cv::Mat sample_nodes(const WarpGrid& grid,
                     const std::function<Eigen::Vector2d(const Eigen::Vector2d& output)>& source_of);

// Source pixel of every output pixel in 32nds, as OpenCV resamples by it.
struct Mapping {
  cv::Mat whole;      // CV_16SC2
  cv::Mat fractions;  // CV_16U: 32 times that of v, plus that of u
};

// The mapping for a source whose first pixel is `origin` of what the nodes refer to. Its sides must be < 32768.
Mapping mapping_of(const WarpGrid& grid, const cv::Mat& nodes, const cv::Point& origin);

// Resamples `grey` (CV_8U) at `mapping` with bicubic interpolation. Where the output is coarser, `shrink` (source
// pixels per output pixel) above 1, the source is first smoothed to the blur of 0.5 output pixels that SIFT assumes of
// its input. Beyond the source's border its edge is repeated, which adds no gradient.
cv::Mat warp_grey(const cv::Mat& grey, const Mapping& mapping, double shrink);

// Nearest-neighbour resampling of a mask (CV_8U); 0 beyond its border.
cv::Mat warp_mask(const cv::Mat& mask, const Mapping& mapping);

// Copy of `grey` in which pixels with valid == 0 have the value of the nearest valid one, so that the border of the
// data makes no gradient. All valid, or none: `grey` itself.
cv::Mat fill_invalid(const cv::Mat& grey, const cv::Mat& valid);

}  // namespace orthonav
