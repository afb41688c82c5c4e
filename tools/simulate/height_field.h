// The world's surface in the form a ray caster wants: a pyramid of heights and luminances, and the range of heights
// in every cell of each level, by which rays skip the empty air.
#pragma once

#include <algorithm>
#include <vector>

#include <Eigen/Core>
#include <opencv2/core.hpp>

#include "tools/simulate/world.h"

namespace orthonav::simulate {

// Immutable after construction; thread-safe. Pixel (u, v) of a level has its centre at integers; outside, the surface
// goes on as at its border.
class HeightField {
 public:
  static constexpr int kCellBits = 3;  // a cell is 8 x 8 pixels of its level

  struct Range {
    float low = 0, high = 0;  // m in G
  };

  struct Level {
    double resolution = 0;  // m per pixel
    cv::Mat height;         // CV_32F, m in G
    cv::Mat luminance;      // CV_8U
    int cell_columns = 0, cell_rows = 0;
    // Of the bilinear surface over each cell, its border to the next cell included.
    std::vector<Range> cells;

    // The cell of a pixel position, which is clamped to the surface.
    const Range& cell(int cell_u, int cell_v) const {
      const int column = std::clamp(cell_u, 0, cell_columns - 1), row = std::clamp(cell_v, 0, cell_rows - 1);
      return cells[static_cast<size_t>(row) * cell_columns + column];
    }
    // Bilinear interpolation at pixel (u, v).
    float height_at(float u, float v) const;
  };

  // Shares the surface's rasters. Throws std::invalid_argument when they are empty, of different size or type, or
  // when a height is not finite.
  explicit HeightField(const Surface& surface);

  const std::vector<Level>& levels() const { return levels_; }
  double resolution() const { return levels_.front().resolution; }
  Range range() const { return range_; }
  // Mean over what is not black: a world made of a photograph is black where it has no picture.
  double mean_luminance() const;

  // Height, m in G, of the surface at a point (east, north) of G; and averaged over about `width` m around it.
  double height(const Eigen::Vector2d& p_en) const;
  double smooth_height(const Eigen::Vector2d& p_en, double width) const;

  // Pixel of a point (east, north) of G in a level.
  Eigen::Vector2d to_pixel(const Eigen::Vector2d& p_en, const Level& level) const {
    return {(p_en.x() - east_min_) / level.resolution - 0.5, (north_max_ - p_en.y()) / level.resolution - 0.5};
  }

 private:
  double east_min_, north_max_;
  std::vector<Level> levels_;
  Range range_;
};

namespace detail {

// Splits a clamped coordinate into the pixel before it and the fraction beyond.
inline int split(float x, int size, float* fraction) {
  const float clamped = std::clamp(x, 0.0F, static_cast<float>(size - 1));
  const int i = std::min(static_cast<int>(clamped), size - 2);
  *fraction = clamped - static_cast<float>(i);
  return i;
}

// Bilinear interpolation where the caller knows that the position and its neighbours lie in the image.
template <class Pixel>
float bilinear_inside(const Pixel* data, int64_t stride, float u, float v) {
  const int i = static_cast<int>(u), j = static_cast<int>(v);
  const float a = u - static_cast<float>(i), b = v - static_cast<float>(j);
  const Pixel* top = data + j * stride + i;
  const Pixel* bottom = top + stride;
  const float upper = static_cast<float>(top[0]) + a * (static_cast<float>(top[1]) - static_cast<float>(top[0]));
  const float lower =
      static_cast<float>(bottom[0]) + a * (static_cast<float>(bottom[1]) - static_cast<float>(bottom[0]));
  return upper + b * (lower - upper);
}

// The same with positions outside clamped to the image.
template <class Pixel>
float bilinear(const cv::Mat& image, float u, float v) {
  float a, b;
  const int i = split(u, image.cols, &a), j = split(v, image.rows, &b);
  const Pixel* top = image.ptr<Pixel>(j) + i;
  const Pixel* bottom = image.ptr<Pixel>(j + 1) + i;
  const float upper = static_cast<float>(top[0]) + a * (static_cast<float>(top[1]) - static_cast<float>(top[0]));
  const float lower =
      static_cast<float>(bottom[0]) + a * (static_cast<float>(bottom[1]) - static_cast<float>(bottom[0]));
  return upper + b * (lower - upper);
}

}  // namespace detail

inline float HeightField::Level::height_at(float u, float v) const {
  return detail::bilinear<float>(height, u, v);
}

}  // namespace orthonav::simulate
