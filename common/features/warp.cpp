#include "common/features/warp.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include <opencv2/imgproc.hpp>

namespace orthonav {

namespace {

constexpr int kFraction = cv::INTER_BITS;  // bits of a pixel's 32nds
constexpr int kFiner = 10;                 // bits beyond these, so that steps from node to node add up
constexpr double kUnits = 1 << (kFraction + kFiner);

}  // namespace

cv::Mat sample_nodes(const WarpGrid& grid,
                     const std::function<Eigen::Vector2d(const Eigen::Vector2d& output)>& source_of) {
  const int columns = (grid.size.width - 1) / grid.step + 2;
  const int rows = (grid.size.height - 1) / grid.step + 2;
  cv::Mat nodes(rows, columns, CV_64FC2);
  for (int row = 0; row < rows; ++row) {
    for (int column = 0; column < columns; ++column) {
      const Eigen::Vector2d source = source_of(Eigen::Vector2d(column * grid.step, row * grid.step));
      nodes.at<cv::Vec2d>(row, column) = cv::Vec2d(source.x(), source.y());
    }
  }
  return nodes;
}

Mapping mapping_of(const WarpGrid& grid, const cv::Mat& nodes, const cv::Point& origin) {
  constexpr int kMask = (1 << kFraction) - 1;
  Mapping mapping{cv::Mat(grid.size, CV_16SC2), cv::Mat(grid.size, CV_16U)};
  // To the nearest 32nd from the origin. What lies far outside is as good as what fits into 16 bits.
  const auto from_origin = [&](const cv::Vec2d& source) {
    constexpr double kHalf = 0.5 / (1 << kFraction), kFar = (1 << 15) - 1;
    return cv::Vec2d(std::clamp(source[0] - origin.x + kHalf, -kFar, kFar),
                     std::clamp(source[1] - origin.y + kHalf, -kFar, kFar));
  };
  for (int v = 0; v < grid.size.height; ++v) {
    const double b = static_cast<double>(v % grid.step) / grid.step;
    const auto* upper = nodes.ptr<cv::Vec2d>(v / grid.step);
    const auto* lower = nodes.ptr<cv::Vec2d>(v / grid.step + 1);
    for (int column = 0; column * grid.step < grid.size.width; ++column) {
      auto* whole = mapping.whole.ptr<int16_t>(v, column * grid.step);
      auto* fractions = mapping.fractions.ptr<uint16_t>(v, column * grid.step);
      const cv::Vec2d left = from_origin(upper[column] * (1 - b) + lower[column] * b);
      const cv::Vec2d right = from_origin(upper[column + 1] * (1 - b) + lower[column + 1] * b);
      const cv::Vec2i start = kUnits * left;
      const cv::Vec2i step = kUnits / grid.step * (right - left);
      const int count = std::min(grid.step, grid.size.width - column * grid.step);
      for (int i = 0; i < count; ++i) {
        const int x = (start[0] + i * step[0]) >> kFiner;
        const int y = (start[1] + i * step[1]) >> kFiner;
        whole[2 * i] = static_cast<int16_t>(x >> kFraction);
        whole[2 * i + 1] = static_cast<int16_t>(y >> kFraction);
        fractions[i] = static_cast<uint16_t>(((y & kMask) << kFraction) + (x & kMask));
      }
    }
  }
  return mapping;
}

cv::Mat warp_grey(const cv::Mat& grey, const Mapping& mapping, double shrink) {
  cv::Mat smooth = grey;
  if (shrink > 1.0) {
    const double sigma = 0.5 * std::sqrt(shrink * shrink - 1.0);
    if (sigma > 0.1) {
      smooth = cv::Mat();  // a copy shares its pixels with `grey`, which is not to be blurred again by the next call
      cv::GaussianBlur(grey, smooth, cv::Size(), sigma, sigma, cv::BORDER_REPLICATE);
    }
  }
  cv::Mat out;
  cv::remap(smooth, out, mapping.whole, mapping.fractions, cv::INTER_CUBIC, cv::BORDER_REPLICATE);
  return out;
}

cv::Mat warp_mask(const cv::Mat& mask, const Mapping& mapping) {
  cv::Mat out(mapping.whole.size(), CV_8U);
  constexpr int kHalf = 1 << (kFraction - 1);
  for (int v = 0; v < out.rows; ++v) {
    const auto* whole = mapping.whole.ptr<cv::Vec2s>(v);
    const auto* fractions = mapping.fractions.ptr<uint16_t>(v);
    auto* to = out.ptr<uchar>(v);
    for (int u = 0; u < out.cols; ++u) {
      const int x = whole[u][0] + ((fractions[u] & kHalf) != 0 ? 1 : 0);
      const int y = whole[u][1] + ((fractions[u] >> kFraction & kHalf) != 0 ? 1 : 0);
      const bool inside = x >= 0 && y >= 0 && x < mask.cols && y < mask.rows;
      to[u] = inside ? mask.ptr<uchar>(y)[x] : uchar{0};
    }
  }
  return out;
}

cv::Mat fill_invalid(const cv::Mat& grey, const cv::Mat& valid) {
  const int num_valid = cv::countNonZero(valid);
  if (num_valid == 0 || num_valid == valid.rows * valid.cols) return grey;
  cv::Mat holes = valid == 0;
  cv::Mat distance;
  cv::Mat labels;
  cv::distanceTransform(holes, distance, labels, cv::DIST_L2, cv::DIST_MASK_5, cv::DIST_LABEL_PIXEL);
  // Labels number the valid pixels; what number each has is read off the valid pixels themselves.
  std::vector<uchar> value_of(static_cast<size_t>(num_valid) + 1, 0);
  for (int v = 0; v < grey.rows; ++v) {
    for (int u = 0; u < grey.cols; ++u) {
      if (valid.at<uchar>(v, u) != 0) value_of.at(static_cast<size_t>(labels.at<int>(v, u))) = grey.at<uchar>(v, u);
    }
  }
  cv::Mat filled = grey.clone();
  for (int v = 0; v < grey.rows; ++v) {
    for (int u = 0; u < grey.cols; ++u) {
      if (valid.at<uchar>(v, u) == 0) {
        filled.at<uchar>(v, u) = value_of.at(static_cast<size_t>(labels.at<int>(v, u)));
      }
    }
  }
  return filled;
}

}  // namespace orthonav
