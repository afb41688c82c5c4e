// The map's features as the grid they are, and a coarse copy of it for searches over all of it.
//
// The features of a grid lie where G's east and north are multiples of the stride, so the feature below any place is
// found by its index. The coarse copy holds every second feature in each direction, with the 4 x 4 histograms of its
// descriptor added up to 2 x 2: 32 bytes in place of 128, for a quarter of the features. It is laid out by pairs of
// components, so that one instruction compares two components of many features.
//
// Immutable after construction.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include <Eigen/Core>
#include <opencv2/core.hpp>

#include "common/features/fixed_sift.h"
#include "services/registration/types.h"

namespace orthonav::registration {

inline constexpr int kCoarseBytes = 32;
// Length of a coarse descriptor of the map, and of one that it is compared with: components of the latter have 7 bits,
// and a product of two stays below 2^15, as does every partial sum of one.
inline constexpr double kCoarseLength = 255, kCoarseQueryLength = 127;

// Adds up 2 x 2 histograms of a RootSIFT descriptor, which are sums of gradients again once squared; `length` long.
void coarsen(const uint8_t* descriptor, double length, uint8_t* coarse);

class MapIndex {
 public:
  // Descriptors of sums of gradients have much in common; what is the same everywhere says nothing of a place, and
  // features near the mean look like everything. So likeness is the correlation of what differs from the mean m:
  //   (q - m).(f - m) / |f - m| = (q.f - q.m) scale - offset,
  // with scale = 1 / |f - m| and offset = (f.m - m.m) scale of the feature.
  struct Centring {
    float scale = 0, offset = 0;
  };
  // What likeness a descriptor q has to features of no relation, those of the whole map: of d = (f - m) / |f - m| the
  // mean and the covariance say mean and variance of (q - m).d.
  template <int size>
  struct Spread {
    Eigen::Matrix<float, size, 1> mean_feature = Eigen::Matrix<float, size, 1>::Zero();  // m
    Eigen::Matrix<float, size, 1> mean = Eigen::Matrix<float, size, 1>::Zero();
    Eigen::Matrix<float, size, size> covariance = Eigen::Matrix<float, size, size>::Zero();
  };

  // Takes the features. Throws std::invalid_argument when there are none, their descriptors are not of kSiftBytes,
  // they are no grid of geometry's stride, or it spans more than a hundred million cells.
  MapIndex(MapFeatures features, const MapGeometry& geometry);

  int rows() const { return rows_; }        // from north to south
  int columns() const { return columns_; }  // from west to east
  double pitch() const { return pitch_; }   // m between neighbours
  // East and north of the feature of a cell, m, whether there is one or not.
  Eigen::Vector2d place(int row, int column) const { return origin_ + pitch_ * Eigen::Vector2d(column, -row); }
  // Column and row, with fractions, of a place.
  Eigen::Vector2d cell(const Eigen::Vector2d& en) const {
    return {(en.x() - origin_.x()) / pitch_, (origin_.y() - en.y()) / pitch_};
  }

  // Feature of a cell, -1 where there is none or outside.
  int feature(int row, int column) const {
    if (row < 0 || column < 0 || row >= rows_ || column >= columns_) return -1;
    return cells_[static_cast<size_t>(row) * static_cast<size_t>(columns_) + static_cast<size_t>(column)];
  }
  // The same of `count` cells of a row, from `column` on. Few, mostly: no copying in blocks.
  void features(int row, int column, int count, int* out) const {
    const bool inside = row >= 0 && row < rows_;
    const int32_t* cells = cells_.data() + static_cast<ptrdiff_t>(inside ? row : 0) * columns_;
    for (int i = 0; i < count; ++i) {
      const int at = column + i;
      out[i] = inside && at >= 0 && at < columns_ ? cells[at] : -1;
    }
  }
  int num_features() const { return descriptors_.rows; }
  const uint8_t* descriptor(int feature) const { return descriptors_.ptr(feature); }
  const Eigen::Vector3f& position(int feature) const { return positions_[static_cast<size_t>(feature)]; }

  const Centring& centring(int feature) const { return centring_[static_cast<size_t>(feature)]; }
  const Spread<kSiftBytes>& spread() const { return *spread_; }

  int coarse_rows() const { return (rows_ + 1) / 2; }
  int coarse_columns() const { return (columns_ + 1) / 2; }
  // One row of the coarse grid: kCoarseBytes times coarse_columns() bytes, the first two components of all columns,
  // then the next two ...; zeros where there is no feature.
  const uint8_t* coarse_row(int row) const {
    return &coarse_[static_cast<size_t>(row) * kCoarseBytes * static_cast<size_t>(coarse_columns())];
  }

  // The scales (of products with a query, which is shorter), and the offsets, of the features of a coarse row; without
  // a feature the offset is beyond reach.
  const float* coarse_scales(int row) const {
    return &coarse_scales_[static_cast<size_t>(row) * static_cast<size_t>(coarse_columns())];
  }
  const float* coarse_offsets(int row) const {
    return &coarse_offsets_[static_cast<size_t>(row) * static_cast<size_t>(coarse_columns())];
  }
  const Spread<kCoarseBytes>& coarse_spread() const { return *coarse_spread_; }

 private:
  void place_features();
  void make_coarse();

  std::vector<Eigen::Vector3f> positions_;
  cv::Mat descriptors_;
  double pitch_;
  Eigen::Vector2d origin_ = Eigen::Vector2d::Zero();  // east and north of cell (0, 0)
  int rows_ = 0, columns_ = 0;
  std::vector<int32_t> cells_;
  std::vector<uint8_t> coarse_;
  std::unique_ptr<Spread<kSiftBytes>> spread_;
  std::unique_ptr<Spread<kCoarseBytes>> coarse_spread_;
  std::vector<Centring> centring_;
  std::vector<float> coarse_scales_, coarse_offsets_;
};

}  // namespace orthonav::registration
