// Outlier test for tracked features when the rotation between the two images is known.
//
// With the rotation from the gyroscope only the direction of translation is unknown, and two correspondences give it:
// t is normal to each (R b1) x b2. Unlike a fundamental matrix this holds on a plane, and unlike a homography it
// holds where there is relief; when there is no translation every feature obeys every t. Deterministic.
#pragma once

#include <vector>

#include <Eigen/Core>

namespace orthonav::vio {

// For each correspondence, whether it agrees with the direction of translation that most agree with.
//   rays_1, rays_2  bearings with z = 1 in the first and second camera, of equal number
//   R_2_1           rotation taking the first camera's coordinates to the second's
//   threshold       distance from the epipolar line on the plane z = 1 (pixels over focal length)
// All are kept when there are fewer than 8, too few to tell.
std::vector<bool> two_point_inliers(const std::vector<Eigen::Vector3d>& rays_1,
                                    const std::vector<Eigen::Vector3d>& rays_2, const Eigen::Matrix3d& R_2_1,
                                    double threshold);

}  // namespace orthonav::vio
