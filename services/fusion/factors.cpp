#include "services/fusion/factors.h"

#include <algorithm>
#include <cmath>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

#include "common/math/so3.h"

namespace orthonav::fusion {
namespace {

template <int Rows>
using PaddedJacobian = Eigen::Matrix<double, Rows, kAmbient, Eigen::RowMajor>;

// Writes a Jacobian with respect to the tangent into the block Ceres gave, if it asked for one.
template <int Rows>
void write_jacobian(double** jacobians, int block, const Eigen::Matrix<double, Rows, kTangent>& J) {
  if (jacobians == nullptr || jacobians[block] == nullptr) return;
  for (int row = 0; row < Rows; ++row) {
    double* out = jacobians[block] + row * kAmbient;
    for (int column = 0; column < 6; ++column) out[column] = J(row, column);
    out[6] = 0.0;
    out[7] = J(row, 6);
  }
}

// U with U^T U = covariance^-1.
template <int N>
Eigen::Matrix<double, N, N> sqrt_information_of(const Eigen::Matrix<double, N, N>& covariance) {
  const Eigen::Matrix<double, N, N> identity = Eigen::Matrix<double, N, N>::Identity();
  return Eigen::LLT<Eigen::Matrix<double, N, N>>(covariance).matrixL().solve(identity);
}

}  // namespace

RelativeFactor::RelativeFactor(const Eigen::Vector3d& dp, const Eigen::Quaterniond& dq, const Matrix6d& covariance,
                               double scale_stddev)
    : dp_(dp), dq_(dq.normalized()) {
  sqrt_information_.setZero();
  sqrt_information_.topLeftCorner<6, 6>() = sqrt_information_of<6>(covariance);
  sqrt_information_(6, 6) = 1.0 / scale_stddev;
}

bool RelativeFactor::Evaluate(const double* const* parameters, double* residuals, double** jacobians) const {
  const NodeState i = NodeState::from(parameters[0]);
  const NodeState j = NodeState::from(parameters[1]);
  const Eigen::Matrix3d R_i_transposed = i.q().toRotationMatrix().transpose();
  const Eigen::Vector3d d = j.p() - i.p();
  const double scale = std::exp(i.log_scale());
  const Eigen::Vector3d rotation_error = so3_log(dq_.conjugate() * i.q().conjugate() * j.q());

  Tangent r;
  r << R_i_transposed * d - scale * dp_, rotation_error, j.log_scale() - i.log_scale();
  Eigen::Map<Tangent>(residuals, kTangent) = sqrt_information_ * r;

  if (jacobians != nullptr) {
    const Eigen::Matrix3d rotation_jacobian =
        so3_right_jacobian_inverse(rotation_error) * j.q().toRotationMatrix().transpose();
    TangentMatrix J_i = TangentMatrix::Zero();
    J_i.block<3, 3>(0, 0) = -R_i_transposed;
    J_i.block<3, 3>(0, 3) = R_i_transposed * skew(d);
    J_i.block<3, 1>(0, 6) = -scale * dp_;
    J_i.block<3, 3>(3, 3) = -rotation_jacobian;
    J_i(6, 6) = -1.0;
    TangentMatrix J_j = TangentMatrix::Zero();
    J_j.block<3, 3>(0, 0) = R_i_transposed;
    J_j.block<3, 3>(3, 3) = rotation_jacobian;
    J_j(6, 6) = 1.0;
    write_jacobian<kTangent>(jacobians, 0, sqrt_information_ * J_i);
    write_jacobian<kTangent>(jacobians, 1, sqrt_information_ * J_j);
  }
  return true;
}

PositionFactor::PositionFactor(const Eigen::Vector3d& p_G_B, const Eigen::Matrix3d& covariance, double height)
    : p_G_B_(p_G_B), sqrt_information_(sqrt_information_of<3>(covariance)), height_(height) {}

bool PositionFactor::Evaluate(const double* const* parameters, double* residuals, double** jacobians) const {
  const NodeState node = NodeState::from(parameters[0]);
  const double scale = std::exp(node.log_scale());
  const Eigen::Vector3d up = Eigen::Vector3d::UnitZ();
  Eigen::Map<Eigen::Vector3d>(residuals, 3) = sqrt_information_ * (node.p() - p_G_B_ - (scale - 1.0) * height_ * up);
  Eigen::Matrix<double, 3, kTangent> J = Eigen::Matrix<double, 3, kTangent>::Zero();
  J.leftCols<3>() = sqrt_information_;
  J.col(6) = -scale * height_ * sqrt_information_ * up;
  write_jacobian<3>(jacobians, 0, J);
  return true;
}

YawFactor::YawFactor(double yaw, double stddev) : yaw_(yaw), stddev_(stddev) {}

bool YawFactor::Evaluate(const double* const* parameters, double* residuals, double** jacobians) const {
  const Eigen::Vector3d x_axis = NodeState::from(parameters[0]).q() * Eigen::Vector3d::UnitX();
  const double squared = x_axis.head<2>().squaredNorm();
  residuals[0] = wrap_angle(std::atan2(x_axis.y(), x_axis.x()) - yaw_) / stddev_;
  Eigen::Matrix<double, 1, kTangent> J = Eigen::Matrix<double, 1, kTangent>::Zero();
  // A body whose x axis is vertical has no yaw: it then says nothing.
  if (squared > 1e-6) {
    const Eigen::Matrix3d dx = -skew(x_axis);
    J.segment<3>(3) = (x_axis.x() * dx.row(1) - x_axis.y() * dx.row(0)) / (squared * stddev_);
  } else {
    residuals[0] = 0.0;
  }
  write_jacobian<1>(jacobians, 0, J);
  return true;
}

TiltFactor::TiltFactor(const Eigen::Vector3d& up_B, double stddev) : up_B_(up_B.normalized()), stddev_(stddev) {}

bool TiltFactor::Evaluate(const double* const* parameters, double* residuals, double** jacobians) const {
  const Eigen::Matrix3d R_transposed = NodeState::from(parameters[0]).q().toRotationMatrix().transpose();
  const Eigen::Vector3d up = Eigen::Vector3d::UnitZ();
  Eigen::Map<Eigen::Vector3d>(residuals, 3) = (R_transposed * up - up_B_) / stddev_;
  Eigen::Matrix<double, 3, kTangent> J = Eigen::Matrix<double, 3, kTangent>::Zero();
  J.block<3, 3>(0, 3) = R_transposed * skew(up) / stddev_;
  write_jacobian<3>(jacobians, 0, J);
  return true;
}

PriorFactor::PriorFactor(const NodeState& mean, const TangentMatrix& sqrt_information)
    : mean_(mean), sqrt_information_(sqrt_information) {}

std::unique_ptr<PriorFactor> PriorFactor::from_quadratic(const NodeState& point, const TangentMatrix& H,
                                                         const Tangent& b) {
  // Metres, radians and scale differ by orders of magnitude: bring the diagonal to 1 before asking which directions
  // carry no information (their eigenvalues are rounding noise, and must stay without).
  const Tangent unit = H.diagonal().cwiseMax(1e-12).cwiseSqrt();
  const TangentMatrix scaled = unit.cwiseInverse().asDiagonal() * H * unit.cwiseInverse().asDiagonal();
  const Eigen::SelfAdjointEigenSolver<TangentMatrix> eigen(scaled);
  Tangent root = Tangent::Zero();
  Tangent inverse = Tangent::Zero();
  for (int k = 0; k < kTangent; ++k) {
    if (eigen.eigenvalues()(k) <= 1e-11) continue;
    root(k) = std::sqrt(eigen.eigenvalues()(k));
    inverse(k) = 1.0 / eigen.eigenvalues()(k);
  }
  const TangentMatrix V = eigen.eigenvectors();
  const Tangent b_scaled = b.cwiseQuotient(unit);
  const Tangent minimum = -(V * inverse.asDiagonal() * V.transpose() * b_scaled).cwiseQuotient(unit);
  return std::make_unique<PriorFactor>(point.plus(minimum), root.asDiagonal() * V.transpose() * unit.asDiagonal());
}

bool PriorFactor::Evaluate(const double* const* parameters, double* residuals, double** jacobians) const {
  const Tangent delta = NodeState::from(parameters[0]).minus(mean_);
  Eigen::Map<Tangent>(residuals, kTangent) = sqrt_information_ * delta;
  if (jacobians != nullptr) {
    TangentMatrix J = TangentMatrix::Identity();
    // The left Jacobian's inverse is the right one's at the opposite rotation.
    J.block<3, 3>(3, 3) = so3_right_jacobian_inverse(-delta.segment<3>(3));
    write_jacobian<kTangent>(jacobians, 0, sqrt_information_ * J);
  }
  return true;
}

}  // namespace orthonav::fusion
