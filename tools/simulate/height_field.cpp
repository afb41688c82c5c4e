#include "tools/simulate/height_field.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

#include <opencv2/imgproc.hpp>

namespace orthonav::simulate {
namespace {

constexpr int kSmallestLevel = 32;  // pixels: the pyramid ends here

void fill_cells(HeightField::Level& level) {
  const int cell = 1 << HeightField::kCellBits;
  const cv::Mat& height = level.height;
  level.cell_columns = (height.cols + cell - 1) / cell;
  level.cell_rows = (height.rows + cell - 1) / cell;
  level.cells.resize(static_cast<size_t>(level.cell_columns) * level.cell_rows);
  for (int row = 0; row < level.cell_rows; ++row) {
    for (int column = 0; column < level.cell_columns; ++column) {
      HeightField::Range range{std::numeric_limits<float>::max(), std::numeric_limits<float>::lowest()};
      // One pixel more on the far sides: the surface between two cells belongs to the nearer one. One on the near
      // sides too, so that rounding of a coordinate at the edge cannot matter.
      for (int v = std::max(0, row * cell - 1); v <= std::min(height.rows - 1, (row + 1) * cell); ++v) {
        const float* pixel = height.ptr<float>(v);
        for (int u = std::max(0, column * cell - 1); u <= std::min(height.cols - 1, (column + 1) * cell); ++u) {
          range.low = std::min(range.low, pixel[u]);
          range.high = std::max(range.high, pixel[u]);
        }
      }
      level.cells[static_cast<size_t>(row) * level.cell_columns + column] = range;
    }
  }
}

}  // namespace

HeightField::HeightField(const Surface& surface) : east_min_(surface.east_min), north_max_(surface.north_max) {
  if (surface.height.type() != CV_32FC1 || surface.luminance.type() != CV_8UC1 ||
      surface.height.size() != surface.luminance.size() || surface.height.cols < 2 || surface.height.rows < 2 ||
      !(surface.resolution > 0)) {
    throw std::invalid_argument("HeightField: surface needs CV_32F heights and CV_8U luminances of one size");
  }
  if (!cv::checkRange(surface.height, true)) throw std::invalid_argument("HeightField: a height is not finite");
  Level level;
  level.resolution = surface.resolution;
  level.height = surface.height;
  level.luminance = surface.luminance;
  fill_cells(level);
  levels_.push_back(level);
  while (std::min(level.height.cols, level.height.rows) >= 2 * kSmallestLevel) {
    const cv::Rect even(0, 0, level.height.cols / 2 * 2, level.height.rows / 2 * 2);
    const cv::Size half(even.width / 2, even.height / 2);
    Level next;
    next.resolution = 2 * level.resolution;
    cv::resize(level.height(even), next.height, half, 0, 0, cv::INTER_AREA);
    cv::resize(level.luminance(even), next.luminance, half, 0, 0, cv::INTER_AREA);
    fill_cells(next);
    levels_.push_back(next);
    level = next;
  }
  double low, high;
  cv::minMaxLoc(surface.height, &low, &high);
  range_ = {static_cast<float>(low), static_cast<float>(high)};
}

double HeightField::height(const Eigen::Vector2d& p_en) const {
  const Eigen::Vector2d pixel = to_pixel(p_en, levels_.front());
  return levels_.front().height_at(static_cast<float>(pixel.x()), static_cast<float>(pixel.y()));
}

double HeightField::smooth_height(const Eigen::Vector2d& p_en, double width) const {
  size_t i = 0;
  while (i + 1 < levels_.size() && levels_[i].resolution < width) ++i;
  const Eigen::Vector2d pixel = to_pixel(p_en, levels_[i]);
  return levels_[i].height_at(static_cast<float>(pixel.x()), static_cast<float>(pixel.y()));
}

double HeightField::mean_luminance() const {
  const cv::Mat& luminance = levels_[std::min<size_t>(3, levels_.size() - 1)].luminance;
  return cv::mean(luminance, luminance > 0)[0];
}

}  // namespace orthonav::simulate
