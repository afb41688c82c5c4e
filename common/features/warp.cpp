#include "common/features/warp.h"

#include <cmath>
#include <vector>

#include <opencv2/imgproc.hpp>

namespace orthonav {

cv::Mat sample_mapping(const WarpGrid& grid,
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
  cv::Mat mapping(grid.size, CV_32FC2);
  for (int v = 0; v < grid.size.height; ++v) {
    const int row = v / grid.step;
    const double b = static_cast<double>(v % grid.step) / grid.step;
    auto* out = mapping.ptr<cv::Vec2f>(v);
    const auto* upper = nodes.ptr<cv::Vec2d>(row);
    const auto* lower = nodes.ptr<cv::Vec2d>(row + 1);
    for (int u = 0; u < grid.size.width; ++u) {
      const int column = u / grid.step;
      const double a = static_cast<double>(u % grid.step) / grid.step;
      const cv::Vec2d left = upper[column] * (1 - b) + lower[column] * b;
      const cv::Vec2d right = upper[column + 1] * (1 - b) + lower[column + 1] * b;
      out[u] = left * (1 - a) + right * a;
    }
  }
  return mapping;
}

cv::Mat warp_grey(const cv::Mat& grey, const cv::Mat& mapping, double shrink) {
  cv::Mat smooth = grey;
  if (shrink > 1.0) {
    const double sigma = 0.5 * std::sqrt(shrink * shrink - 1.0);
    if (sigma > 0.1) cv::GaussianBlur(grey, smooth, cv::Size(), sigma, sigma, cv::BORDER_REPLICATE);
  }
  cv::Mat out;
  cv::remap(smooth, out, mapping, cv::noArray(), cv::INTER_CUBIC, cv::BORDER_REPLICATE);
  return out;
}

cv::Mat warp_mask(const cv::Mat& mask, const cv::Mat& mapping) {
  cv::Mat out;
  cv::remap(mask, out, mapping, cv::noArray(), cv::INTER_NEAREST, cv::BORDER_CONSTANT, cv::Scalar(0));
  return out;
}

cv::Mat fill_invalid(const cv::Mat& grey, const cv::Mat& valid) {
  const int num_valid = cv::countNonZero(valid);
  if (num_valid == 0 || num_valid == valid.rows * valid.cols) return grey.clone();
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
