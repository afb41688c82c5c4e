#include "services/fusion/factors.h"

#include <cmath>
#include <numbers>

#include <Eigen/Cholesky>

#include "common/math/so3.h"

namespace orthonav::fusion {
namespace {

double huber_weight(double norm, double huber) {
  return norm > huber ? huber / norm : 1.0;
}

// Of the first three rows of the transition's residual, before whitening.
PositionRows motion_jacobian(const Transition& transition, const NodeState& i) {
  const Eigen::Vector3d moved = std::exp(i.log_scale()) * (i.q_G_W() * transition.dp_W);
  PositionRows J = PositionRows::Zero();
  J.leftCols<3>() = -Eigen::Matrix3d::Identity();
  J.middleCols<3>(kYaw) = skew(moved) * rotation_jacobian(i);
  J.col(kScale) = -moved;
  return J;
}

}  // namespace

Eigen::Matrix3d sqrt_information(const Eigen::Matrix3d& covariance) {
  const Eigen::Matrix3d identity = Eigen::Matrix3d::Identity();
  return Eigen::LLT<Eigen::Matrix3d>(covariance).matrixL().solve(identity);
}

Eigen::Matrix2d sqrt_information(const Eigen::Matrix2d& covariance) {
  const Eigen::Matrix2d identity = Eigen::Matrix2d::Identity();
  return Eigen::LLT<Eigen::Matrix2d>(covariance).matrixL().solve(identity);
}

NodeState predict(const Transition& transition, const NodeState& i) {
  NodeState j;
  j.x = transition.decay.cwiseProduct(i.x);
  j.x.segment<2>(kLean) += transition.lean_change;
  j.x.segment<3>(kPosition) = i.p() + std::exp(i.log_scale()) * (i.q_G_W() * transition.dp_W);
  return j;
}

StateVector residual(const Transition& transition, const NodeState& i, const NodeState& j) {
  StateVector r = (j.x - predict(transition, i).x).cwiseQuotient(transition.stddev);
  r.head<3>() = transition.position_root * (j.p() - predict(transition, i).p());
  return r;
}

Eigen::Vector3d residual(const PositionMeasurement& measurement, const NodeState& node) {
  return measurement.root * (node.p() + node.shared() + measurement.lever * node.tilt() - measurement.p_G_B);
}

Eigen::Vector2d residual(const TiltMeasurement& measurement, const NodeState& node) {
  return measurement.root * (node.tilt() - measurement.tilt);
}

PositionRows position_jacobian(const Lever& lever, const NodeState& node) {
  PositionRows J = PositionRows::Zero();
  J.middleCols<3>(kPosition).setIdentity();
  J.middleCols<3>(kYaw) = lever * tilt_jacobian(node);
  J.middleCols<3>(kShared).setIdentity();
  return J;
}

double residual(const HeadingMeasurement& measurement, const NodeState& node) {
  const Eigen::Vector3d x_axis = node.q_G_W() * measurement.x_axis_W;
  const double heading = 0.5 * std::numbers::pi - std::atan2(x_axis.y(), x_axis.x());
  const double bias = measurement.biased ? node.compass_bias() : 0.0;
  return wrap_angle(heading + bias - measurement.heading) / measurement.stddev;
}

StateVector heading_jacobian(const HeadingMeasurement& measurement, const NodeState& node) {
  StateVector J = StateVector::Zero();
  const Eigen::Vector3d x_axis = node.q_G_W() * measurement.x_axis_W;
  const double squared = x_axis.head<2>().squaredNorm();
  if (squared < 1e-6) return J;
  const Eigen::Matrix3d dx = -skew(x_axis) * rotation_jacobian(node);
  J.segment<3>(kYaw) = -(x_axis.x() * dx.row(1) - x_axis.y() * dx.row(0)).transpose() / squared;
  if (measurement.biased) J(kCompassBias) = 1.0;
  return J;
}

PairQuadratic linearise(const Transition& transition, const NodeState& i, const NodeState& j) {
  const StateVector r = residual(transition, i, j);
  const PositionRows A = transition.position_root * motion_jacobian(transition, i);
  const Eigen::Matrix3d& U = transition.position_root;
  const Eigen::Vector3d r_position = r.head<3>();

  PairQuadratic pair;
  pair.i.H.noalias() = A.transpose() * A;
  pair.i.b.noalias() = A.transpose() * r_position;
  pair.j.H.topLeftCorner<3, 3>().noalias() = U.transpose() * U;
  pair.j.b.head<3>().noalias() = U.transpose() * r_position;
  pair.H_ij.leftCols<3>().noalias() = A.transpose() * U;
  for (int k = kYaw; k < kStates; ++k) {
    const double root = 1.0 / transition.stddev(k);
    const double back = -transition.decay(k) * root;
    pair.i.H(k, k) += back * back;
    pair.i.b(k) += back * r(k);
    pair.j.H(k, k) += root * root;
    pair.j.b(k) += root * r(k);
    pair.H_ij(k, k) += back * root;
  }
  pair.j.H.diagonal().segment<2>(kLean).array() += transition.lean_gained;
  pair.j.b.segment<2>(kLean) += transition.lean_gained * j.lean() + transition.lean_known * transition.lean_change;
  return pair;
}

Quadratic linearise(const PositionMeasurement& measurement, const NodeState& node, double huber) {
  const Eigen::Vector3d r = residual(measurement, node);
  const PositionRows J = measurement.root * position_jacobian(measurement.lever, node);
  const double weight = huber_weight(r.norm(), huber);
  Quadratic cost;
  cost.H.noalias() = weight * J.transpose() * J;
  cost.b.noalias() = weight * J.transpose() * r;
  return cost;
}

Quadratic linearise(const TiltMeasurement& measurement, const NodeState& node, double huber) {
  const Eigen::Vector2d r = residual(measurement, node);
  const Eigen::Matrix<double, 2, 3> J = measurement.root * tilt_jacobian(node);
  const double weight = huber_weight(r.norm(), huber);
  Quadratic cost;
  cost.H.block<3, 3>(kYaw, kYaw).noalias() = weight * J.transpose() * J;
  cost.b.segment<3>(kYaw).noalias() = weight * J.transpose() * r;
  return cost;
}

Quadratic linearise(const HeadingMeasurement& measurement, const NodeState& node, double huber) {
  const double r = residual(measurement, node);
  const StateVector J = heading_jacobian(measurement, node) / measurement.stddev;
  const double weight = huber_weight(std::abs(r), huber);
  Quadratic cost;
  cost.H = weight * J * J.transpose();
  cost.b = weight * r * J;
  return cost;
}

Quadratic linearise(const ScaleMeasurement& measurement, const NodeState& node, double huber) {
  const double r = (node.log_scale() - measurement.log_scale) / measurement.stddev;
  const double weight = huber_weight(std::abs(r), huber);
  Quadratic cost;
  cost.H(kScale, kScale) = weight / (measurement.stddev * measurement.stddev);
  cost.b(kScale) = weight * r / measurement.stddev;
  return cost;
}

Quadratic linearise(const Prior& prior, const NodeState& node) {
  Quadratic cost = prior.cost;
  cost.b += prior.cost.H * (node.x - prior.point);
  return cost;
}

}  // namespace orthonav::fusion
