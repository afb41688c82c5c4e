#include "services/registration/submap/ground_slope.h"

#include <cmath>
#include <random>

#include <gtest/gtest.h>

#include "common/math/so3.h"

namespace orthonav::registration {
namespace {

constexpr double kMap = 0.7;  // m, of its heights

// Points of a world seen under a vertical that is off, from `height` m above the ground.
struct Seen {
  std::vector<Eigen::Vector3d> offsets_G;
  std::vector<double> rises;

  Seen(const Eigen::Vector2d& tilt, double height, int on_ground, int on_trees, double depth_stddev) {
    std::mt19937 random(3);
    std::uniform_real_distribution<double> place(-0.6 * height, 0.6 * height);
    std::normal_distribution<double> noise(0, depth_stddev);
    const Eigen::Matrix3d R = so3_exp(Eigen::Vector3d(-tilt.x(), -tilt.y(), 0)).toRotationMatrix();
    for (int i = 0; i < on_ground + on_trees; ++i) {
      const double top = i < on_ground ? 0 : 15;
      const Eigen::Vector3d offset(place(random), place(random), top + noise(random) - height);
      offsets_G.emplace_back(R * offset);
      rises.push_back(offsets_G.back().z() + height);
    }
  }
  GroundSlope slope(double height) const { return slope_of_ground(offsets_G, rises, height, 1, kMap); }
};

TEST(SlopeOfGround, IsTheVerticalsErrorBothWays) {
  for (const Eigen::Vector2d& tilt :
       {Eigen::Vector2d(0.01, 0), Eigen::Vector2d(0, -0.01), Eigen::Vector2d(-0.02, 0.01)}) {
    const GroundSlope slope = Seen(tilt, 200, 300, 0, 1.0).slope(200);
    EXPECT_LT((slope.tilt - tilt).norm(), 0.002) << tilt.transpose();
  }
}

TEST(SlopeOfGround, IsThatOfTheGroundBetweenTrees) {
  const Eigen::Vector2d tilt(0.008, 0.004);
  const GroundSlope slope = Seen(tilt, 110, 60, 140, 0.5).slope(110);
  EXPECT_LT((slope.tilt - tilt).norm(), 0.004);
}

TEST(SlopeOfGround, IsKnownNoBetterThanTheMapsHeights) {
  // Evenly over 1.2 heights: the root mean square is 0.35 heights.
  for (const double height : {110.0, 285.0}) {
    const GroundSlope slope = Seen(Eigen::Vector2d::Zero(), height, 2000, 0, 0.1).slope(height);
    EXPECT_NEAR(std::sqrt(slope.covariance(0, 0)), kMap / (0.3464 * height), 0.1 * kMap / (0.3464 * height)) << height;
  }
}

TEST(SlopeOfGround, IsUnknownWhereNoGroundIsSeenOrItIsALine) {
  EXPECT_GT(std::sqrt(Seen(Eigen::Vector2d::Zero(), 110, 0, 0, 1).slope(110).covariance(0, 0)), 0.9);
  Seen absurd(Eigen::Vector2d::Zero(), 110, 50, 0, 1);
  for (double& rise : absurd.rises) rise -= 1e4;
  const GroundSlope none = absurd.slope(110);
  EXPECT_GT(std::sqrt(none.covariance(0, 0)), 0.5);
  EXPECT_LT(none.tilt.norm(), 0.1);
  Seen line(Eigen::Vector2d(0.01, 0.01), 110, 100, 0, 0.1);
  for (size_t i = 0; i < line.rises.size(); ++i) {
    line.rises[i] += 0.01 * line.offsets_G[i].x();  // a point's share of the tilt about the axis it is moved to
    line.offsets_G[i].x() = 0;
  }
  const GroundSlope along = line.slope(110);
  EXPECT_LT(std::sqrt(along.covariance(0, 0)), 0.03);
  EXPECT_GT(std::sqrt(along.covariance(1, 1)), 0.9);
  EXPECT_NEAR(along.tilt.x(), 0.01, 0.003);
}

}  // namespace
}  // namespace orthonav::registration
