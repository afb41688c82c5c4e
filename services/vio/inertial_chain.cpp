#include "services/vio/inertial_chain.h"

#include <cmath>

namespace orthonav::vio {

std::vector<Inertial> inertial_chain(const std::vector<Frame*>& frames, const Eigen::Vector3d& gyro_bias) {
  std::vector<Inertial> chain(frames.size());
  const Eigen::Vector3d no_bias = Eigen::Vector3d::Zero();
  for (size_t k = 1; k < frames.size(); ++k) {
    const Preintegration& pre = *frames[k]->imu;
    const Inertial& from = chain[k - 1];
    Inertial& to = chain[k];
    to.t = from.t + pre.duration();
    to.alpha = from.alpha + from.beta * pre.duration() + from.R * pre.corrected_alpha(no_bias, gyro_bias);
    to.beta = from.beta + from.R * pre.corrected_beta(no_bias, gyro_bias);
    to.alpha_ba = from.alpha_ba + from.beta_ba * pre.duration() + from.R * pre.jacobian().block<3, 3>(0, 9);
    to.beta_ba = from.beta_ba + from.R * pre.jacobian().block<3, 3>(6, 9);
    to.R = from.R * pre.corrected_gamma(gyro_bias).toRotationMatrix();
  }
  return chain;
}

void set_states(const std::vector<Frame*>& frames, const std::vector<Inertial>& chain, const Eigen::Vector3d& velocity,
                const Eigen::Vector3d& gravity, const Eigen::Vector3d& accel_bias, const Eigen::Vector3d& gyro_bias) {
  const Eigen::Quaterniond q_W_B0 = Eigen::Quaterniond::FromTwoVectors(-gravity, Eigen::Vector3d::UnitZ());
  for (size_t k = 0; k < frames.size(); ++k) {
    const Inertial& inertial = chain[k];
    StateValues& state = frames[k]->state;
    state.p() = q_W_B0 * (velocity * inertial.t + 0.5 * inertial.t * inertial.t * gravity + inertial.alpha +
                          inertial.alpha_ba * accel_bias);
    state.v() = q_W_B0 * (velocity + inertial.t * gravity + inertial.beta + inertial.beta_ba * accel_bias);
    state.q() = q_W_B0 * Eigen::Quaterniond(inertial.R);
    state.ba() = accel_bias;
    state.bg() = gyro_bias;
  }
}

Eigen::Matrix<double, 2, 3> across(const Eigen::Vector3d& bearing) {
  const Eigen::Vector3d helper = std::abs(bearing.z()) < 0.9 ? Eigen::Vector3d::UnitZ() : Eigen::Vector3d::UnitX();
  Eigen::Matrix<double, 2, 3> N;
  N.row(0) = bearing.cross(helper).normalized().transpose();
  N.row(1) = bearing.cross(N.row(0).transpose()).transpose();
  return N;
}

}  // namespace orthonav::vio
