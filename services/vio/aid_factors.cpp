#include "services/vio/aid_factors.h"

#include <algorithm>

#include "common/math/so3.h"

namespace orthonav::vio {
namespace {

using PoseRow = Eigen::Matrix<double, 1, 7>;

void put_pose(double* out, const Eigen::Matrix<double, 1, 6>& value) {
  if (!out) return;
  Eigen::Map<PoseRow> row(out);
  row << value, 0.0;
}

}  // namespace

bool StandstillFactor::Evaluate(double const* const* parameters, double* residuals, double** jacobians) const {
  for (int k = 0; k < 3; ++k) residuals[k] = parameters[0][k] / sigma_;
  if (jacobians && jacobians[0]) {
    Eigen::Map<Eigen::Matrix<double, 3, 9, Eigen::RowMajor>> J(jacobians[0]);
    J.setZero();
    J.leftCols<3>().diagonal().setConstant(1.0 / sigma_);
  }
  return true;
}

HeightFactor::HeightFactor(const HeightMeasurement& measured, const Eigen::Vector3d& ray_i,
                           const Extrinsics& extrinsics)
    : measured_(measured), ray_i_(ray_i), extrinsics_(extrinsics) {}

double HeightFactor::evaluate(const HeightMeasurement& measured, const Eigen::Vector3d& ray_i,
                              const Extrinsics& extrinsics, const double* pose_i, const double* pose_j,
                              double inverse_depth, double bias, Jacobians* jacobians) {
  const Eigen::Map<const Eigen::Vector3d> p_i(pose_i), p_j(pose_j);
  const Eigen::Map<const Eigen::Quaterniond> q_i(pose_i + 3);
  const double weight = 1.0 / measured.stddev;
  const Eigen::Vector3d ray_B = extrinsics.R_B_C * ray_i;
  const Eigen::Vector3d point_B = ray_B / inverse_depth + extrinsics.p_B_C;
  const Eigen::Matrix3d R_i = q_i.toRotationMatrix();
  const double ground = p_i.z() + R_i.row(2).dot(point_B);
  if (jacobians) {
    jacobians->pose_j << 0, 0, weight, 0, 0, 0;
    jacobians->pose_i << 0, 0, -weight, weight * R_i.row(2) * skew(point_B);
    jacobians->inverse_depth = weight * R_i.row(2).dot(ray_B) / (inverse_depth * inverse_depth);
    jacobians->bias = weight;
  }
  return weight * (p_j.z() - ground + bias - measured.height);
}

bool HeightFactor::Evaluate(double const* const* parameters, double* residuals, double** jacobians) const {
  Jacobians J;
  residuals[0] =
      evaluate(measured_, ray_i_, extrinsics_, parameters[0], parameters[1], *parameters[2], *parameters[3], &J);
  if (!jacobians) return true;
  put_pose(jacobians[0], J.pose_i);
  put_pose(jacobians[1], J.pose_j);
  if (jacobians[2]) *jacobians[2] = J.inverse_depth;
  if (jacobians[3]) *jacobians[3] = J.bias;
  return true;
}

DistanceFactor::DistanceFactor(double distance, double sigma) : distance_(distance), sigma_(sigma) {}

bool DistanceFactor::Evaluate(double const* const* parameters, double* residuals, double** jacobians) const {
  const Eigen::Vector3d way =
      Eigen::Map<const Eigen::Vector3d>(parameters[1]) - Eigen::Map<const Eigen::Vector3d>(parameters[0]);
  residuals[0] = (way.norm() - distance_) / sigma_;
  if (!jacobians) return true;
  Eigen::Matrix<double, 1, 6> J = Eigen::Matrix<double, 1, 6>::Zero();
  J.leftCols<3>() = way.normalized().transpose() / sigma_;
  put_pose(jacobians[1], J);
  put_pose(jacobians[0], -J);
  return true;
}

}  // namespace orthonav::vio
