// A closed-form start of the window: velocity, gravity, biases and the depths of points.
//
// With rotations from the gyroscope and b a bearing, the camera positions are linear in the first frame's velocity v
// and gravity g, P_k = v t_k + g t_k^2 / 2 + alpha_k, so that each observation of a point gives two equations linear
// in (v, accelerometer bias, g, depth). Each depth is eliminated, |g| is imposed exactly by a Lagrange multiplier, and
// the gyroscope bias is found by Gauss-Newton on what remains (variable projection). No fundamental matrix and no
// structure from motion beforehand: a flat scene is as good as any, and all tracks are used together. After Martinelli
// (IJCV 2014) and Kaiser et al. (RA-L 2017). The estimator refines the result and decides whether to trust it.
#pragma once

#include <map>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "common/camera/camera_model.h"
#include "services/vio/state.h"

namespace orthonav::vio {

struct LinearStart {
  bool ok = false;
  std::string reason;                                   // why not
  Eigen::Vector3d gyro_bias = Eigen::Vector3d::Zero();  // rad/s, as well as was found
  double residual = 0;                                  // root mean square of the equations, pixels
};

// Solves for the frames (at least 4, in order, each but the first with its `imu`) and, when it is ok, sets their
// states (W: gravity-aligned, origin and yaw at the first frame) and the depths of the landmarks seen in at least two
// of them. The preintegrations are left about the gyroscope bias found.
//   gyro_bias, gyro_bias_sigma  what is known of the bias beforehand, rad/s
//   accel_bias_sigma            of the accelerometer's bias about zero, m/s^2
//   weight                      focal length over the standard deviation of a pixel
//   pixel_sigma                 that standard deviation, pixels
LinearStart solve_linear_start(const std::vector<Frame*>& frames, std::map<int64_t, Landmark>& landmarks,
                               const Extrinsics& extrinsics, double gravity, const Eigen::Vector3d& gyro_bias,
                               double gyro_bias_sigma, double accel_bias_sigma, double weight, double pixel_sigma);

}  // namespace orthonav::vio
