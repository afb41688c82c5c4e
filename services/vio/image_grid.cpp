#include "services/vio/image_grid.h"

#include <algorithm>
#include <cmath>

namespace orthonav::vio {

ImageGrid::ImageGrid(const cv::Size& size, int count)
    : size_(size),
      side_(std::sqrt(static_cast<double>(size.width) * size.height / std::max(1, count))),
      columns_(std::max(1, static_cast<int>(std::lround(size.width / side_)))),
      rows_(std::max(1, static_cast<int>(std::lround(size.height / side_)))),
      width_(static_cast<double>(size.width) / columns_),
      height_(static_cast<double>(size.height) / rows_) {}

size_t ImageGrid::cell_of(const Eigen::Vector2d& pixel) const {
  const int column = std::clamp(static_cast<int>((pixel.x() + 0.5) / width_), 0, columns_ - 1);
  const int row = std::clamp(static_cast<int>((pixel.y() + 0.5) / height_), 0, rows_ - 1);
  return static_cast<size_t>(row * columns_ + column);
}

cv::Rect ImageGrid::area(size_t cell) const {
  const int row = static_cast<int>(cell) / columns_, column = static_cast<int>(cell) % columns_;
  return cv::Rect(static_cast<int>(column * width_), static_cast<int>(row * height_), static_cast<int>(width_),
                  static_cast<int>(height_)) &
         cv::Rect({0, 0}, size_);
}

std::vector<int> ImageGrid::occupancy(const std::vector<TrackedFeature>& features) const {
  std::vector<int> count(static_cast<size_t>(size()));
  for (const TrackedFeature& feature : features) ++count[cell_of(feature.pixel)];
  return count;
}

std::vector<bool> kept_apart(const std::vector<TrackedFeature>& features, double distance) {
  std::vector<bool> stays(features.size(), true);
  for (size_t i = 0; i < features.size(); ++i) {
    for (size_t k = 0; k < i && stays[i]; ++k) {
      stays[i] = !stays[k] || (features[k].pixel - features[i].pixel).squaredNorm() >= distance * distance;
    }
  }
  return stays;
}

}  // namespace orthonav::vio
