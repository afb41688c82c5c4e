#include "services/vio/projection_factor.h"

#include <algorithm>

#include "common/math/so3.h"

namespace orthonav::vio {

bool PoseManifold::Plus(const double* x, const double* delta, double* x_plus_delta) const {
  for (int k = 0; k < 3; ++k) x_plus_delta[k] = x[k] + delta[k];
  const Eigen::Map<const Eigen::Quaterniond> q(x + 3);
  Eigen::Map<Eigen::Quaterniond> out(x_plus_delta + 3);
  out = (q * so3_exp(Eigen::Map<const Eigen::Vector3d>(delta + 3))).normalized();
  return true;
}

bool PoseManifold::PlusJacobian(const double*, double* jacobian) const {
  Eigen::Map<Eigen::Matrix<double, 7, 6, Eigen::RowMajor>> J(jacobian);
  J.setIdentity();
  return true;
}

bool PoseManifold::Minus(const double* y, const double* x, double* y_minus_x) const {
  for (int k = 0; k < 3; ++k) y_minus_x[k] = y[k] - x[k];
  const Eigen::Map<const Eigen::Quaterniond> q_y(y + 3), q_x(x + 3);
  Eigen::Map<Eigen::Vector3d>(y_minus_x + 3) = so3_log(q_x.conjugate() * q_y);
  return true;
}

bool PoseManifold::MinusJacobian(const double*, double* jacobian) const {
  Eigen::Map<Eigen::Matrix<double, 6, 7, Eigen::RowMajor>> J(jacobian);
  J.setIdentity();
  return true;
}

bool DepthManifold::Plus(const double* x, const double* delta, double* x_plus_delta) const {
  // 1 / x_new = 1 / x - delta / x^2, and not nearer than a tenth of what it was.
  *x_plus_delta = *x / std::max(0.1, 1.0 - *delta / *x);
  return true;
}

bool DepthManifold::PlusJacobian(const double*, double* jacobian) const {
  *jacobian = 1;
  return true;
}

bool DepthManifold::Minus(const double* y, const double* x, double* y_minus_x) const {
  *y_minus_x = *x - *x * *x / *y;
  return true;
}

bool DepthManifold::MinusJacobian(const double*, double* jacobian) const {
  *jacobian = 1;
  return true;
}

Bearings bearings_of(const Observation& anchor, const Observation& other) {
  return {anchor.ray, other.ray, anchor.rate, other.rate, anchor.frame->time_shift, other.frame->time_shift};
}

ProjectionFactor::ProjectionFactor(const Bearings& bearings, const Shared& shared, const Extrinsics& extrinsics,
                                   double weight)
    : bearings_(bearings), shared_(shared), extrinsics_(extrinsics), weight_(weight) {}

bool ProjectionFactor::evaluate(const Bearings& bearings, double time_offset, const Extrinsics& extrinsics,
                                double weight, const double* pose_i, const double* pose_j, double inverse_depth,
                                Eigen::Vector2d* residual, Jacobians* jacobians) {
  const Eigen::Map<const Eigen::Vector3d> p_i(pose_i), p_j(pose_j);
  const Eigen::Map<const Eigen::Quaterniond> q_i(pose_i + 3), q_j(pose_j + 3);
  Eigen::Vector3d ray_i = bearings.ray_i;
  ray_i.head<2>() -= bearings.rate_i * (time_offset - bearings.shift_i);
  const Eigen::Vector2d seen = bearings.ray_j.head<2>() - bearings.rate_j * (time_offset - bearings.shift_j);
  // Everything times the inverse depth, which keeps points at infinity finite.
  const Eigen::Matrix3d R_i = q_i.toRotationMatrix();
  const Eigen::Matrix3d R_C_W = (q_j.toRotationMatrix() * extrinsics.R_B_C).transpose();
  const Eigen::Vector3d ray_B = extrinsics.R_B_C * ray_i;
  const Eigen::Vector3d point_Bi = ray_B + inverse_depth * extrinsics.p_B_C;
  const Eigen::Vector3d step = R_i * extrinsics.p_B_C + p_i - p_j;
  const Eigen::Vector3d point_Bj = q_j.conjugate() * (R_i * ray_B + inverse_depth * step);
  const Eigen::Vector3d point_C = extrinsics.R_B_C.transpose() * (point_Bj - inverse_depth * extrinsics.p_B_C);
  if (point_C.z() < 1e-3) return false;
  const double iz = 1.0 / point_C.z();
  const double x = point_C.x() * iz, y = point_C.y() * iz;
  if (residual) *residual = weight * (Eigen::Vector2d(x, y) - seen);
  if (!jacobians) return true;
  Eigen::Matrix<double, 2, 3> reduce;
  reduce << iz, 0, -x * iz, 0, iz, -y * iz;
  reduce *= weight;
  const Eigen::Matrix<double, 2, 3> d_world = reduce * R_C_W;
  const Eigen::Matrix<double, 2, 3> d_ray = d_world * R_i * extrinsics.R_B_C;
  const Eigen::Matrix<double, 2, 3> d_body = reduce * extrinsics.R_B_C.transpose();
  jacobians->pose_i.leftCols<3>() = inverse_depth * d_world;
  jacobians->pose_i.rightCols<3>() = -d_world * R_i * skew(point_Bi);
  jacobians->pose_j.leftCols<3>() = -inverse_depth * d_world;
  jacobians->pose_j.rightCols<3>() = d_body * skew(point_Bj);
  jacobians->camera.leftCols<3>() = inverse_depth * (d_world * R_i - d_body);
  jacobians->camera.rightCols<3>() = reduce * skew(point_C) - d_ray * skew(ray_i);
  jacobians->inverse_depth = reduce * (R_C_W * step - extrinsics.R_B_C.transpose() * extrinsics.p_B_C);
  jacobians->time_offset = weight * bearings.rate_j - d_ray.leftCols<2>() * bearings.rate_i;
  return true;
}

bool ProjectionFactor::Evaluate(double const* const* parameters, double* residuals, double** jacobians) const {
  Eigen::Vector2d r;
  Jacobians J;
  const double inverse_depth = *parameters[2], time_offset = *parameters[4];
  Extrinsics moved;
  if (shared_.camera_free) {
    SharedValues values;
    std::copy_n(parameters[3], 7, values.camera.begin());
    moved = values.extrinsics();
  }
  const Extrinsics& extrinsics = shared_.camera_free ? moved : extrinsics_;
  if (!evaluate(bearings_, time_offset, extrinsics, weight_, parameters[0], parameters[1], inverse_depth, &r,
                jacobians ? &J : nullptr)) {
    return false;
  }
  Eigen::Map<Eigen::Vector2d>{residuals} = r;
  if (!jacobians) return true;
  using PoseJacobian = Eigen::Matrix<double, 2, 7, Eigen::RowMajor>;
  const auto put_pose = [&](int k, const Eigen::Matrix<double, 2, 6>& value) {
    if (!jacobians[k]) return;
    Eigen::Map<PoseJacobian> out(jacobians[k]);
    out.leftCols<6>() = value;
    out.col(6).setZero();
  };
  put_pose(0, J.pose_i);
  put_pose(1, J.pose_j);
  put_pose(3, J.camera);
  if (jacobians[2]) Eigen::Map<Eigen::Vector2d>{jacobians[2]} = J.inverse_depth;
  if (jacobians[4]) Eigen::Map<Eigen::Vector2d>{jacobians[4]} = J.time_offset;
  return true;
}

}  // namespace orthonav::vio
