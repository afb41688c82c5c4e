// The terms of the graph's cost, with analytic Jacobians.
//
// Each is a ceres::CostFunction over one or two NodeState blocks; Jacobians are with respect to the tangent,
// padded as NodeManifold says. All residuals are whitened (unit variance). Immutable after construction.
#pragma once

#include <memory>

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <ceres/sized_cost_function.h>

#include "services/fusion/node_state.h"
#include "services/fusion/types.h"

namespace orthonav::fusion {

// Motion from node i to node j as the odometry saw it, equations (12) and (13), with the odometry's scale:
//   R_i^T (p_j - p_i) - exp(s_i) dp,   Log(dR^T R_i^T R_j),   s_j - s_i.
class RelativeFactor final : public ceres::SizedCostFunction<kTangent, kAmbient, kAmbient> {
 public:
  // `dp`: position of j in B_i; `dq`: q_Bi_Bj; `covariance` of (dp in B_i, rotation vector in B_j), positive
  // definite; `scale_stddev`: how much the log scale may change from i to j, > 0.
  RelativeFactor(const Eigen::Vector3d& dp, const Eigen::Quaterniond& dq, const Matrix6d& covariance,
                 double scale_stddev);
  bool Evaluate(const double* const* parameters, double* residuals, double** jacobians) const override;

 private:
  Eigen::Vector3d dp_;
  Eigen::Quaterniond dq_;
  TangentMatrix sqrt_information_;
};

// Absolute position of a node from the map, equation (14).
//
// A fix finds where the odometry's points lie and steps back from them by the odometry's height above them, which has
// the odometry's scale: the fix is too low by (exp(s) - 1) height. Residual: p - (fix + (exp(s) - 1) height e_z).
class PositionFactor final : public ceres::SizedCostFunction<3, kAmbient> {
 public:
  // `covariance`: m^2, positive definite; `height`: m, the odometry's above the ground; 0: the fix's height does not
  // depend on the odometry's scale.
  PositionFactor(const Eigen::Vector3d& p_G_B, const Eigen::Matrix3d& covariance, double height = 0.0);
  bool Evaluate(const double* const* parameters, double* residuals, double** jacobians) const override;

 private:
  Eigen::Vector3d p_G_B_;
  Eigen::Matrix3d sqrt_information_;
  double height_;
};

// Yaw of a node's body, counter-clockwise from east.
class YawFactor final : public ceres::SizedCostFunction<1, kAmbient> {
 public:
  YawFactor(double yaw, double stddev);
  bool Evaluate(const double* const* parameters, double* residuals, double** jacobians) const override;

 private:
  double yaw_;
  double stddev_;
};

// Direction of "up" in the body, which an odometry with an accelerometer knows without drift.
class TiltFactor final : public ceres::SizedCostFunction<3, kAmbient> {
 public:
  TiltFactor(const Eigen::Vector3d& up_B, double stddev);
  bool Evaluate(const double* const* parameters, double* residuals, double** jacobians) const override;

 private:
  Eigen::Vector3d up_B_;
  double stddev_;
};

// A Gaussian over one node: what is left of the nodes before it after their marginalisation.
//   sqrt_information * (x minus mean)
class PriorFactor final : public ceres::SizedCostFunction<kTangent, kAmbient> {
 public:
  PriorFactor(const NodeState& mean, const TangentMatrix& sqrt_information);
  // From the quadratic cost 1/2 d^T H d + b^T d in d = x minus `point`; H positive semidefinite.
  static std::unique_ptr<PriorFactor> from_quadratic(const NodeState& point, const TangentMatrix& H, const Tangent& b);
  bool Evaluate(const double* const* parameters, double* residuals, double** jacobians) const override;

 private:
  NodeState mean_;
  TangentMatrix sqrt_information_;
};

}  // namespace orthonav::fusion
