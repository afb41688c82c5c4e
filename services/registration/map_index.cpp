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
// Offset of a coarse cell without a feature.
constexpr float kNowhere = 1e9F;

template <size_t N>
float product(const std::array<float, N>& mean, const uint8_t* descriptor) {
  float sum = 0;
  for (size_t k = 0; k < N; ++k) sum += mean[k] * static_cast<float>(descriptor[k]);
  return sum;
}

template <size_t N>
MapIndex::Centring centring_of(const std::array<float, N>& mean, float squared_mean, const uint8_t* descriptor) {
  float squared = 0;
  for (size_t k = 0; k < N; ++k) squared += static_cast<float>(descriptor[k]) * static_cast<float>(descriptor[k]);
  const float with_mean = product(mean, descriptor);
  const float scale = 1 / std::sqrt(std::max(1.0F, squared - 2 * with_mean + squared_mean));
  return {scale, (with_mean - squared_mean) * scale};
}

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
  place_features();
  take_sample();
  centring_.resize(positions_.size());
  for (int i = 0; i < num_features(); ++i) {
    centring_[static_cast<size_t>(i)] = centring_of(mean_, squared_mean_, descriptor(i));
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

void MapIndex::take_sample() {
  const int step = std::max(1, num_features() / kSampleSize);
  for (int i = step / 2; i < num_features() && static_cast<int>(sample_.size()) < kSampleSize; i += step) {
    sample_.push_back(i);
  }
  const auto share = 1 / static_cast<float>(sample_.size());
  std::array<uint8_t, kCoarseBytes> reduced{};
  coarse_sample_.create(kCoarseBytes, static_cast<int>(sample_.size()), CV_8U);
  for (size_t i = 0; i < sample_.size(); ++i) {
    const uint8_t* of = descriptor(sample_[i]);
    coarsen(of, reduced.data());
    for (size_t k = 0; k < kSiftBytes; ++k) mean_[k] += share * static_cast<float>(of[k]);
    for (size_t k = 0; k < kCoarseBytes; ++k) {
      coarse_mean_[k] += share * static_cast<float>(reduced[k]);
      coarse_sample_.at<uint8_t>(static_cast<int>(k), static_cast<int>(i)) = reduced[k];
    }
  }
  for (const float value : mean_) squared_mean_ += value * value;
  for (const float value : coarse_mean_) squared_coarse_mean_ += value * value;
  for (const int feature : sample_) {
    coarsen(descriptor(feature), reduced.data());
    coarse_sample_centring_.push_back(centring_of(coarse_mean_, squared_coarse_mean_, reduced.data()));
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
      coarsen(descriptor(found), reduced.data());
      for (size_t k = 0; k < kCoarseBytes; ++k) out[k * columns + column] = reduced[k];
      const Centring centring = centring_of(coarse_mean_, squared_coarse_mean_, reduced.data());
      const size_t cell = static_cast<size_t>(row) * columns + column;
      coarse_scales_[cell] = centring.scale;
      coarse_offsets_[cell] = centring.offset;
    }
  }
}

float MapIndex::product_with_mean(const uint8_t* descriptor) const {
  return product(mean_, descriptor);
}

float MapIndex::product_with_coarse_mean(const uint8_t* coarse) const {
  return product(coarse_mean_, coarse);
}

}  // namespace orthonav::registration
