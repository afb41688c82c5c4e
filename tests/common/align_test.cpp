#include "common/math/align.h"

#include <cmath>
#include <limits>
#include <random>

#include <Eigen/Geometry>
#include <gtest/gtest.h>

#include "common/math/statistics.h"

namespace orthonav {
namespace {

std::vector<Eigen::Vector3d> random_points(int count) {
  std::mt19937 generator(3);
  std::normal_distribution<double> normal(0, 10);
  std::vector<Eigen::Vector3d> points;
  for (int i = 0; i < count; ++i) points.emplace_back(normal(generator), normal(generator), normal(generator));
  return points;
}

TEST(Align, UmeyamaRecoversASimilarity) {
  const auto from = random_points(20);
  Similarity truth{1.7, Eigen::AngleAxisd(2.1, Eigen::Vector3d(1, 2, 3).normalized()).toRotationMatrix(), {5, -6, 7}};
  std::vector<Eigen::Vector3d> to;
  for (const auto& p : from) to.push_back(truth * p);
  const Similarity found = align_umeyama(from, to, true);
  EXPECT_NEAR(found.scale, 1.7, 1e-12);
  EXPECT_LT((found.R - truth.R).norm(), 1e-12);
  EXPECT_LT((found.t - truth.t).norm(), 1e-11);
}

TEST(Align, YawAlignmentLeavesTiltAndScaleAlone) {
  const auto from = random_points(20);
  Similarity truth{1.0, Eigen::AngleAxisd(-0.8, Eigen::Vector3d::UnitZ()).toRotationMatrix(), {1, 2, 3}};
  std::vector<Eigen::Vector3d> to;
  for (const auto& p : from) to.push_back(truth * p);
  const Similarity found = align_yaw_translation(from, to);
  EXPECT_LT((found.R - truth.R).norm(), 1e-12);
  EXPECT_LT((found.t - truth.t).norm(), 1e-11);
  EXPECT_EQ(found.scale, 1.0);
}

TEST(Align, RefusesTooFewPairs) {
  EXPECT_THROW(align_umeyama(random_points(2), random_points(2), true), std::invalid_argument);
  EXPECT_THROW(align_umeyama(random_points(4), random_points(5), true), std::invalid_argument);
}

TEST(Statistics, QuantilesInterpolate) {
  EXPECT_DOUBLE_EQ(median({3, 1, 2}), 2.0);
  EXPECT_DOUBLE_EQ(median({4, 1, 2, 3}), 2.5);
  EXPECT_DOUBLE_EQ(quantile({0, 10}, 0.99), 9.9);
  EXPECT_DOUBLE_EQ(quantile({5}, 0.2), 5.0);
  EXPECT_TRUE(std::isnan(median({})));
  EXPECT_DOUBLE_EQ(root_mean_square({3, 4}), std::sqrt(12.5));
}

}  // namespace
}  // namespace orthonav
