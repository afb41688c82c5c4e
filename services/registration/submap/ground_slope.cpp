#include "services/registration/submap/ground_slope.h"

#include <Eigen/Cholesky>
#include <Eigen/LU>

#include "services/registration/submap/ground_level.h"

namespace orthonav::registration {

GroundSlope slope_of_ground(const std::vector<Eigen::Vector3d>& offsets_G, const std::vector<double>& rises,
                            double height, double matches_per_point, double ground_height_stddev) {
  constexpr int kIterations = 5;
  constexpr double kAnyTilt = 1;  // rad: what is known where no ground is seen
  // Of the level, and of the tilt: (tilt x offset) in height.
  const auto row = [&](size_t i) { return Eigen::Vector3d(1, offsets_G[i].y(), -offsets_G[i].x()); };
  // One more point that lies where it is expected to: few say little of how all scatter.
  const double expected = ground_height_stddev * ground_height_stddev;
  Eigen::Vector3d plane = Eigen::Vector3d::Zero();
  Eigen::Matrix3d moments;
  double squares = 0, weights = 0;
  for (int iteration = 0; iteration < kIterations; ++iteration) {
    moments = 1e-9 * Eigen::Matrix3d::Identity();
    Eigen::Vector3d sums = Eigen::Vector3d::Zero();
    squares = expected;
    weights = 1;
    for (size_t i = 0; i < rises.size(); ++i) {
      const double rise = rises[i] + row(i).dot(plane);
      const double weight = GroundLevel::above(rise, height).on_the_ground;
      moments += weight * row(i) * row(i).transpose();
      sums += weight * row(i) * rises[i];
      squares += weight * rise * rise;
      weights += weight;
    }
    plane = moments.ldlt().solve(-sums);
  }
  const double counted = matches_per_point * squares / weights + weights * expected;
  GroundSlope slope;
  const Eigen::Matrix2d known = Eigen::Matrix2d((counted * moments.inverse()).bottomRightCorner<2, 2>()).inverse();
  slope.covariance = (known + Eigen::Matrix2d::Identity() / (kAnyTilt * kAnyTilt)).inverse();
  slope.tilt = slope.covariance * known * plane.tail<2>();
  return slope;
}

}  // namespace orthonav::registration
