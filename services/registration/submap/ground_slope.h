// What the odometry's vertical is off by, told from how the ground lies: the odometry's points on it slope against the
// map's by so much. Pure, thread-safe.
//
// What it errs by is the map's: an error of the elevation model goes on over all that a keyframe sees, 0.4 degrees of
// 0.7 m at 285 m and 67 degrees, 1.1 at 110 m and 41. The perspective of the points' rays tells the same, weaker by the
// height over the points' distance.
#pragma once

#include <vector>

#include <Eigen/Core>

namespace orthonav::registration {

struct GroundSlope {
  Eigen::Vector2d tilt = Eigen::Vector2d::Zero();        // rad about east and north: R_G_B = Exp(tilt) R_odometry
  Eigen::Matrix2d covariance = Eigen::Matrix2d::Zero();  // rad^2; large where little ground is seen
};

// `offsets_G`: the points' from the body under the odometry's vertical, m; `rises`: how far each then lies above the
// ground's level, m, one for each offset (GroundLevel::above says what is on the ground). `height`: of the body above
// it, m. So many matches are of the same point, and its depth's error is its own; `ground_height_stddev`, m, is that of
// the map's heights, which all share.
GroundSlope slope_of_ground(const std::vector<Eigen::Vector3d>& offsets_G, const std::vector<double>& rises,
                            double height, double matches_per_point, double ground_height_stddev);

}  // namespace orthonav::registration
