#include "services/registration/map/map_index.h"

#include <gtest/gtest.h>

#include "tests/registration/synthetic_flight.h"

namespace orthonav::registration {
namespace {

const SyntheticFields& ground() {
  static const SyntheticFields instance{1};
  return instance;
}

TEST(MapIndex, FindsEveryFeatureByItsPlace) {
  MapFeatures all = described_map(ground());
  // Holes, as water and missing data leave them.
  MapFeatures some;
  for (size_t i = 0; i < all.positions.size(); ++i) {
    if (i % 7 == 3 || i < 200) continue;
    some.positions.push_back(all.positions[i]);
    some.descriptors.push_back(all.descriptors.row(static_cast<int>(i)));
  }
  const MapFeatures given = some;
  const MapIndex index(std::move(some), kFieldsMap);
  EXPECT_EQ(index.pitch(), 3.0);
  int found = 0;
  for (int row = 0; row < index.rows(); ++row) {
    for (int column = 0; column < index.columns(); ++column) {
      const int feature = index.feature(row, column);
      if (feature < 0) continue;
      ++found;
      const Eigen::Vector2d en = given.positions[static_cast<size_t>(feature)].head<2>().cast<double>();
      EXPECT_LT((index.place(row, column) - en).norm(), 1e-3);
      EXPECT_LT((index.cell(en) - Eigen::Vector2d(column, row)).norm(), 1e-3);
    }
  }
  EXPECT_EQ(found, index.num_features());
  EXPECT_EQ(index.feature(-1, 0), -1);
  EXPECT_EQ(index.feature(0, index.columns()), -1);
}

TEST(MapIndex, RefusesWhatIsNoGrid) {
  EXPECT_THROW(MapIndex({}, kFieldsMap), std::invalid_argument);
  EXPECT_THROW(MapIndex(described_map(ground()), {0.3, 12, 0}), std::invalid_argument);
  MapFeatures far = described_map(ground());
  far.positions.front().x() = 1e8F;
  EXPECT_THROW(MapIndex(std::move(far), kFieldsMap), std::invalid_argument);
  MapFeatures nan = described_map(ground());
  nan.positions.front().x() = NAN;
  EXPECT_THROW(MapIndex(std::move(nan), kFieldsMap), std::invalid_argument);
  MapFeatures floats = described_map(ground());
  floats.descriptors.convertTo(floats.descriptors, CV_32F);
  EXPECT_THROW(MapIndex(std::move(floats), kFieldsMap), std::invalid_argument);
}

}  // namespace
}  // namespace orthonav::registration
