// A start over flat ground, where the closed form of initialiser.h fails.
//
// That form finds each point's depth from noisy bearings; high up and on a straight leg the depths' part of its
// equations is the smaller one, and noise pulls points behind the camera. Over ground that is about level the depths
// are known but for one number, the height h: the camera's way follows from the bearings in units of h, linearly, and
// h, velocity and gravity follow from comparing it with what the IMU integrated. Coarse where the ground is not flat,
// and useless where the camera does not look down; the estimator refines the result and decides whether to trust it.
#pragma once

#include <map>

#include "services/vio/initialiser.h"

namespace orthonav::vio {

// As solve_linear_start, for frames whose preintegrations may be about any bias, and with the gyroscope's bias known.
//   focal  pixels
LinearStart solve_flat_start(const std::vector<Frame*>& frames, std::map<int64_t, Landmark>& landmarks,
                             const Extrinsics& extrinsics, double gravity, const Eigen::Vector3d& gyro_bias,
                             double focal);

}  // namespace orthonav::vio
