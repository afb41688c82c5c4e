#include "services/registration/map/map_index.h"

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
// Offset of a coarse cell without a feature.
constexpr float kNowhere = 1e9F;

template <int size>
Eigen::Matrix<float, size, 1> values_of(const uint8_t* descriptor) {
  return Eigen::Map<const Eigen::Matrix<uint8_t, size, 1>>(descriptor).template cast<float>();
}

template <int size>
MapIndex::Centring centring_of(const Eigen::Matrix<float, size, 1>& mean, const uint8_t* descriptor) {
  const Eigen::Matrix<float, size, 1> difference = values_of<size>(descriptor) - mean;
  const float scale = 1 / std::max(1.0F, difference.norm());
  return {scale, difference.dot(mean) * scale};
}

// Of a sample of descriptors.
template <int size>
std::unique_ptr<MapIndex::Spread<size>> spread_of(const std::vector<const uint8_t*>& descriptors) {
  auto spread = std::make_unique<MapIndex::Spread<size>>();
  const float share = 1 / static_cast<float>(descriptors.size());
  for (const uint8_t* each : descriptors) spread->mean_feature += share * values_of<size>(each);
  for (const uint8_t* each : descriptors) {
    const Eigen::Matrix<float, size, 1> difference = values_of<size>(each) - spread->mean_feature;
    const Eigen::Matrix<float, size, 1> direction = difference / std::max(1.0F, difference.norm());
    spread->mean += share * direction;
    spread->covariance += share * direction * direction.transpose();
  }
  spread->covariance -= spread->mean * spread->mean.transpose();
  return spread;
}

}  // namespace

void coarsen(const uint8_t* descriptor, double length, uint8_t* coarse) {
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
  const float scale = total > 0 ? static_cast<float>(length * length) / total : 0;
  // Rounded down, or the products of two could exceed 15 bits.
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
  if (descriptors_.type() != CV_8UC1 || descriptors_.cols != kSiftBytes || !descriptors_.isContinuous()) {
    throw std::invalid_argument("the map's descriptors are not of 128 bytes, one after the other");
  }
  if (!(pitch_ > 0)) throw std::invalid_argument("the map's features are no grid");
  place_features();
  // Features spread evenly over the map.
  std::vector<const uint8_t*> sample, coarse_sample;
  std::vector<std::array<uint8_t, kCoarseBytes>> coarse(kSampleSize);
  const int step = std::max(1, num_features() / kSampleSize);
  for (int i = step / 2; i < num_features() && sample.size() < kSampleSize; i += step) {
    coarsen(descriptor(i), kCoarseLength, coarse[sample.size()].data());
    coarse_sample.push_back(coarse[sample.size()].data());
    sample.push_back(descriptor(i));
  }
  spread_ = spread_of<kSiftBytes>(sample);
  coarse_spread_ = spread_of<kCoarseBytes>(coarse_sample);
  centring_.reserve(positions_.size());
  for (int i = 0; i < num_features(); ++i) {
    centring_.push_back(centring_of<kSiftBytes>(spread_->mean_feature, descriptor(i)));
  }
  make_coarse();
}

void MapIndex::place_features() {
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
}

void MapIndex::make_coarse() {
  const auto columns = static_cast<size_t>(coarse_columns());
  const size_t cells = static_cast<size_t>(coarse_rows()) * columns;
  coarse_.assign(cells * kCoarseBytes, 0);
  coarse_scales_.assign(cells, 0.0F);
  coarse_offsets_.assign(cells, kNowhere);
  std::array<uint8_t, kCoarseBytes> reduced{};
  for (int row = 0; row < coarse_rows(); ++row) {
    uint8_t* out = &coarse_[static_cast<size_t>(row) * kCoarseBytes * columns];
    for (size_t column = 0; column < columns; ++column) {
      int found = -1;
      for (const auto& [v, u] : {std::pair{0, 0}, {0, 1}, {1, 0}, {1, 1}}) {
        if (found < 0) found = feature(2 * row + v, 2 * static_cast<int>(column) + u);
      }
      if (found < 0) continue;
      coarsen(descriptor(found), kCoarseLength, reduced.data());
      for (size_t k = 0; k < kCoarseBytes; ++k) out[k / 2 * 2 * columns + 2 * column + k % 2] = reduced[k];
      const Centring centring = centring_of<kCoarseBytes>(coarse_spread_->mean_feature, reduced.data());
      const size_t cell = static_cast<size_t>(row) * columns + column;
      coarse_scales_[cell] = static_cast<float>(kCoarseLength / kCoarseQueryLength) * centring.scale;
      coarse_offsets_[cell] = centring.offset;
    }
  }
}

}  // namespace orthonav::registration
