// What the IMU alone says of the frames of a window, in B of its first one: how a start integrates.
#pragma once

#include <vector>

#include <Eigen/Core>

#include "services/vio/state.h"

namespace orthonav::vio {

struct Inertial {
  double t = 0;  // s since the first frame
  Eigen::Matrix3d R = Eigen::Matrix3d::Identity();
  // Position and velocity, m and m/s, without the first frame's velocity and without gravity.
  Eigen::Vector3d alpha = Eigen::Vector3d::Zero(), beta = Eigen::Vector3d::Zero();
  // Their derivatives with respect to the accelerometer bias.
  Eigen::Matrix3d alpha_ba = Eigen::Matrix3d::Zero(), beta_ba = Eigen::Matrix3d::Zero();
};

// One for each frame, at a gyroscope bias (rad/s) and no accelerometer bias, to first order about the bias that each
// frame's preintegration was made with.
std::vector<Inertial> inertial_chain(const std::vector<Frame*>& frames, const Eigen::Vector3d& gyro_bias);

// Sets the frames' states from the first frame's velocity, gravity and accelerometer bias, all in its B; W has z
// against gravity and no turn about it beyond that.
void set_states(const std::vector<Frame*>& frames, const std::vector<Inertial>& chain, const Eigen::Vector3d& velocity,
                const Eigen::Vector3d& gravity, const Eigen::Vector3d& accel_bias, const Eigen::Vector3d& gyro_bias);

// Rows that span the plane across a bearing.
Eigen::Matrix<double, 2, 3> across(const Eigen::Vector3d& bearing);

}  // namespace orthonav::vio
