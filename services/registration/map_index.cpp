#include "services/registration/map_index.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "common/features/fixed_sift.h"

namespace orthonav::registration {
namespace {

constexpr int64_t kMaxCells = 100'000'000;
constexpr int kSampleSize = 512;

}  // namespace

void coarsen(const uint8_t* descriptor, uint8_t* coarse) {
  std::array<float, kCoarseBytes> sums{};
  for (int cell = 0; cell < 16; ++cell) {
    const int target = (cell / 8) * 2 + (cell % 4) / 2;
    for (int k = 0; k < 8; ++k) {
      const auto value = static_cast<float>(descriptor[cell * 8 + k]);
      sums[static_cast<size_t>(target * 8 + k)] += value * value;
    }
  }
  float total = 0;
  for (const float sum : sums) total += sum;
  const float scale = total > 0 ? static_cast<float>(kCoarseLength * kCoarseLength) / total : 0;
  // Rounded down, or the products of two could exceed 16 bits.
  for (int i = 0; i < kCoarseBytes; ++i) {
    coarse[i] = static_cast<uint8_t>(std::sqrt(scale * sums[static_cast<size_t>(i)]));
  }
}

MapIndex::MapIndex(MapFeatures features, const MapGeometry& geometry)
    : positions_(std::move(features.positions)),
      descriptors_(std::move(features.descriptors)),
      pitch_(geometry.keypoint_stride * geometry.metres_per_pixel) {
  if (positions_.empty() || static_cast<size_t>(descriptors_.rows) != positions_.size()) {
    throw std::invalid_argument("the map has no features, or positions and descriptors differ in number");
  }
  if (descriptors_.type() != CV_8UC1 || descriptors_.cols != kSiftBytes) {
    throw std::invalid_argument("the map's descriptors are not of 128 bytes");
  }
  if (!(pitch_ > 0)) throw std::invalid_argument("the map's features are no grid");
  // Interest points are in the middle of squares of the stride.
  const auto lattice = [this](const Eigen::Vector3f& p) {
    return Eigen::Vector2d(std::floor(p.x() / pitch_), std::floor(-p.y() / pitch_));
  };
  Eigen::Vector2d low(1e300, 1e300);
  Eigen::Vector2d high = -low;
  for (const Eigen::Vector3f& p : positions_) {
    if (!p.allFinite()) throw std::invalid_argument("a position of the map is not finite");
    low = low.cwiseMin(lattice(p));
    high = high.cwiseMax(lattice(p));
  }
  const Eigen::Vector2d size = high - low + Eigen::Vector2d::Ones();
  if (size.x() * size.y() > kMaxCells) throw std::invalid_argument("the map's features are too far apart for a grid");
  const Eigen::Vector2d first = lattice(positions_.front()) - low;
  origin_ = positions_.front().head<2>().cast<double>() + pitch_ * Eigen::Vector2d(-first.x(), first.y());
  columns_ = static_cast<int>(size.x());
  rows_ = static_cast<int>(size.y());
  cells_.assign(static_cast<size_t>(rows_) * static_cast<size_t>(columns_), -1);
  for (size_t i = 0; i < positions_.size(); ++i) {
    const Eigen::Vector2d at = lattice(positions_[i]) - low;
    cells_[static_cast<size_t>(at.y()) * static_cast<size_t>(columns_) + static_cast<size_t>(at.x())] =
        static_cast<int32_t>(i);
  }

  coarse_.assign(static_cast<size_t>(coarse_rows()) * kCoarseBytes * static_cast<size_t>(coarse_columns()), 0);
  std::array<uint8_t, kCoarseBytes> reduced{};
  for (int row = 0; row < coarse_rows(); ++row) {
    uint8_t* out = &coarse_[static_cast<size_t>(row) * kCoarseBytes * static_cast<size_t>(coarse_columns())];
    for (int column = 0; column < coarse_columns(); ++column) {
      int found = -1;
      for (const auto& [v, u] : {std::pair{0, 0}, {0, 1}, {1, 0}, {1, 1}}) {
        if (found < 0) found = feature(2 * row + v, 2 * column + u);
      }
      if (found < 0) continue;
      coarsen(descriptor(found), reduced.data());
      for (int k = 0; k < kCoarseBytes; ++k) {
        out[static_cast<size_t>(k) * static_cast<size_t>(coarse_columns()) + static_cast<size_t>(column)] =
            reduced[static_cast<size_t>(k)];
      }
    }
  }

  const int step = std::max(1, num_features() / kSampleSize);
  for (int i = step / 2; i < num_features() && static_cast<int>(sample_.size()) < kSampleSize; i += step) {
    sample_.push_back(i);
  }
  coarse_sample_.create(kCoarseBytes, static_cast<int>(sample_.size()), CV_8U);
  for (size_t i = 0; i < sample_.size(); ++i) {
    coarsen(descriptor(sample_[i]), reduced.data());
    for (int k = 0; k < kCoarseBytes; ++k) {
      coarse_sample_.at<uint8_t>(k, static_cast<int>(i)) = reduced[static_cast<size_t>(k)];
    }
  }
}

}  // namespace orthonav::registration
