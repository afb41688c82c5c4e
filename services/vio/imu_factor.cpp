#include "services/vio/imu_factor.h"

#include <algorithm>

#include "common/math/so3.h"

namespace orthonav::vio {

ImuFactor::ImuFactor(const Preintegration& preintegration, double gravity)
    : preintegration_(preintegration), gravity_(gravity) {}

void ImuFactor::evaluate(const Preintegration& pre, const StateValues& i, const StateValues& j, double gravity,
                         Vector15* residual, Jacobians* jacobians) {
  const Eigen::Vector3d g(0, 0, -gravity);
  const double T = pre.duration();
  const Eigen::Matrix3d R_i_t = i.q().toRotationMatrix().transpose();
  const Eigen::Vector3d a = R_i_t * (j.p() - i.p() - i.v() * T - 0.5 * T * T * g);
  const Eigen::Vector3d b = R_i_t * (j.v() - i.v() - T * g);
  const Eigen::Quaterniond error = pre.corrected_gamma(i.bg()).conjugate() * i.q().conjugate() * j.q();
  const Eigen::Vector3d r_theta = so3_log(error);
  const Preintegration::Matrix15& L = pre.sqrt_information();
  if (residual) {
    Vector15 r;
    r << a - pre.corrected_alpha(i.ba(), i.bg()), r_theta, b - pre.corrected_beta(i.ba(), i.bg()), j.ba() - i.ba(),
        j.bg() - i.bg();
    *residual = L * r;
  }
  if (!jacobians) return;
  const Preintegration::Matrix15& J = pre.jacobian();
  const Eigen::Matrix3d Jr_inv = so3_right_jacobian_inverse(r_theta);
  const Eigen::Matrix3d I = Eigen::Matrix3d::Identity();

  Eigen::Matrix<double, 15, 6> pose = Eigen::Matrix<double, 15, 6>::Zero();
  pose.block<3, 3>(0, 0) = -R_i_t;
  pose.block<3, 3>(0, 3) = skew(a);
  pose.block<3, 3>(3, 3) = -Jr_inv * (j.q().conjugate() * i.q()).toRotationMatrix();
  pose.block<3, 3>(6, 3) = skew(b);
  jacobians->pose_i = L * pose;

  Eigen::Matrix<double, 15, 9> speed = Eigen::Matrix<double, 15, 9>::Zero();
  speed.block<3, 3>(0, 0) = -T * R_i_t;
  speed.block<3, 6>(0, 3) = -J.block<3, 6>(0, 9);
  const Eigen::Matrix3d J_theta = J.block<3, 3>(3, 12);
  speed.block<3, 3>(3, 6) = -Jr_inv * error.toRotationMatrix().transpose() *
                            so3_right_jacobian(J_theta * (i.bg() - pre.gyro_bias())) * J_theta;
  speed.block<3, 3>(6, 0) = -R_i_t;
  speed.block<3, 6>(6, 3) = -J.block<3, 6>(6, 9);
  speed.block<3, 3>(9, 3) = -I;
  speed.block<3, 3>(12, 6) = -I;
  jacobians->speed_bias_i = L * speed;

  pose.setZero();
  pose.block<3, 3>(0, 0) = R_i_t;
  pose.block<3, 3>(3, 3) = Jr_inv;
  jacobians->pose_j = L * pose;

  speed.setZero();
  speed.block<3, 3>(6, 0) = R_i_t;
  speed.block<3, 3>(9, 3) = I;
  speed.block<3, 3>(12, 6) = I;
  jacobians->speed_bias_j = L * speed;
}

bool ImuFactor::Evaluate(double const* const* parameters, double* residuals, double** jacobians) const {
  StateValues i, j;
  std::copy_n(parameters[0], 7, i.pose.begin());
  std::copy_n(parameters[1], 9, i.speed_bias.begin());
  std::copy_n(parameters[2], 7, j.pose.begin());
  std::copy_n(parameters[3], 9, j.speed_bias.begin());
  Vector15 r;
  Jacobians J;
  evaluate(preintegration_, i, j, gravity_, &r, jacobians ? &J : nullptr);
  Eigen::Map<Vector15>{residuals} = r;
  if (!jacobians) return true;
  using PoseJacobian = Eigen::Matrix<double, 15, 7, Eigen::RowMajor>;
  using SpeedJacobian = Eigen::Matrix<double, 15, 9, Eigen::RowMajor>;
  const auto put_pose = [&](int k, const Eigen::Matrix<double, 15, 6>& value) {
    if (!jacobians[k]) return;
    Eigen::Map<PoseJacobian> out(jacobians[k]);
    out.leftCols<6>() = value;
    out.col(6).setZero();
  };
  put_pose(0, J.pose_i);
  if (jacobians[1]) Eigen::Map<SpeedJacobian>{jacobians[1]} = J.speed_bias_i;
  put_pose(2, J.pose_j);
  if (jacobians[3]) Eigen::Map<SpeedJacobian>{jacobians[3]} = J.speed_bias_j;
  return true;
}

}  // namespace orthonav::vio
