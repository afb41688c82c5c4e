// The graph's terms: gradients and Jacobians against central differences.
#include "services/fusion/factors.h"

#include <cmath>
#include <functional>

#include <gtest/gtest.h>

#include "common/math/so3.h"

namespace orthonav::fusion {
namespace {

NodeState some_node(double k) {
  NodeState node;
  node.x << 10.0 * k, -4.0 + k, 110.0, 1.0 + 0.3 * k, 0.01 * k, -0.02, 0.02 * k, 0.1, 0.5, -0.3 * k, 1.0;
  return node;
}

Transition some_transition() {
  Transition transition;
  transition.dp_W = Eigen::Vector3d(3.0, 0.5, -0.2);
  Eigen::Matrix3d covariance;
  covariance << 0.04, 0.01, 0.002, 0.01, 0.09, -0.005, 0.002, -0.005, 0.02;
  transition.position_root = sqrt_information(covariance);
  for (int k = kYaw; k < kStates; ++k) {
    transition.decay(k) = 1.0 - 0.02 * k;
    transition.stddev(k) = 0.05 + 0.01 * k;
  }
  return transition;
}

StateVector numeric_gradient(const std::function<double(const NodeState&)>& cost, const NodeState& at) {
  StateVector gradient;
  for (int k = 0; k < kStates; ++k) {
    NodeState ahead = at, behind = at;
    ahead.x(k) += 1e-6;
    behind.x(k) -= 1e-6;
    gradient(k) = (cost(ahead) - cost(behind)) / 2e-6;
  }
  return gradient;
}

void expect_close(const Eigen::MatrixXd& a, const Eigen::MatrixXd& b, double tolerance = 1e-5) {
  EXPECT_LT((a - b).norm(), tolerance * std::max(1.0, b.norm())) << a << "\n\n" << b;
}

TEST(FusionFactors, RotationJacobianMatchesFiniteDifferences) {
  const NodeState node = some_node(1.0);
  const Eigen::Matrix3d J = rotation_jacobian(node);
  for (int k = 0; k < 3; ++k) {
    NodeState ahead = node, behind = node;
    ahead.x(kYaw + k) += 1e-6;
    behind.x(kYaw + k) -= 1e-6;
    const Eigen::Vector3d numeric = so3_log(ahead.q_G_W() * behind.q_G_W().conjugate()) / 2e-6;
    EXPECT_LT((J.col(k) - numeric).norm(), 1e-6) << k;
  }
}

TEST(FusionFactors, TheLeanIsOfTheOdometrysWorld) {
  // Leaning by 10 mrad about its y axis, W's x axis points down, wherever it points on the map.
  for (const double yaw : {0.0, 1.0, -2.5}) {
    NodeState node;
    node.x(kYaw) = yaw;
    node.x(kLean + 1) = 0.01;
    const Eigen::Vector3d x_axis = node.q_G_W() * Eigen::Vector3d::UnitX();
    EXPECT_NEAR(x_axis.z(), -std::sin(0.01), 1e-12) << yaw;
    EXPECT_NEAR(std::remainder(yaw_of(node.q_G_W()) - yaw, 2 * M_PI), 0.0, 1e-12) << yaw;
    const Eigen::Vector3d rotation = so3_log(node.q_G_W() * Eigen::AngleAxisd(-yaw, Eigen::Vector3d::UnitZ()));
    EXPECT_LT((rotation.head<2>() - node.tilt()).norm(), 1e-12) << yaw;
  }
}

TEST(FusionFactors, TiltJacobianMatchesFiniteDifferences) {
  const NodeState node = some_node(1.0);
  const Eigen::Matrix<double, 2, 3> J = tilt_jacobian(node);
  for (int k = 0; k < 3; ++k) {
    NodeState ahead = node, behind = node;
    ahead.x(kYaw + k) += 1e-6;
    behind.x(kYaw + k) -= 1e-6;
    EXPECT_LT((J.col(k) - (ahead.tilt() - behind.tilt()) / 2e-6).norm(), 1e-8) << k;
  }
}

TEST(FusionFactors, TransitionLinearisesItsResidual) {
  const Transition transition = some_transition();
  const NodeState i = some_node(1.0), j = some_node(1.2);
  const PairQuadratic pair = linearise(transition, i, j);
  const auto cost = [&](const NodeState& a, const NodeState& b) {
    return 0.5 * residual(transition, a, b).squaredNorm();
  };
  expect_close(pair.i.b, numeric_gradient([&](const NodeState& a) { return cost(a, j); }, i));
  expect_close(pair.j.b, numeric_gradient([&](const NodeState& b) { return cost(i, b); }, j));
  // Gauss-Newton's Hessian from the residual's own differences.
  Eigen::Matrix<double, kStates, kStates> J_i, J_j;
  for (int k = 0; k < kStates; ++k) {
    NodeState ahead = i, behind = i;
    ahead.x(k) += 1e-6;
    behind.x(k) -= 1e-6;
    J_i.col(k) = (residual(transition, ahead, j) - residual(transition, behind, j)) / 2e-6;
    ahead = behind = j;
    ahead.x(k) += 1e-6;
    behind.x(k) -= 1e-6;
    J_j.col(k) = (residual(transition, i, ahead) - residual(transition, i, behind)) / 2e-6;
  }
  expect_close(pair.i.H, J_i.transpose() * J_i);
  expect_close(pair.j.H, J_j.transpose() * J_j);
  expect_close(pair.H_ij, J_i.transpose() * J_j);
}

TEST(FusionFactors, TheMeasuredMotionWithTheNodesScaleLeavesNoResidual) {
  const NodeState i = some_node(1.0);
  const Transition transition = some_transition();
  EXPECT_LT(residual(transition, i, predict(transition, i)).norm(), 1e-9);
  const Eigen::Vector3d moved = predict(transition, i).p() - i.p();
  EXPECT_NEAR(moved.norm(), std::exp(i.log_scale()) * transition.dp_W.norm(), 1e-12);
}

// Gradient and Gauss-Newton's Hessian of a measurement against the residual's own differences.
template <typename Measurement>
void expect_linearised(const Measurement& measurement, const NodeState& node) {
  const Quadratic cost = linearise(measurement, node, 1e9);
  expect_close(
      cost.b, numeric_gradient([&](const NodeState& n) { return 0.5 * residual(measurement, n).squaredNorm(); }, node));
  Eigen::Matrix<double, Eigen::Dynamic, kStates> J(residual(measurement, node).size(), kStates);
  for (int k = 0; k < kStates; ++k) {
    NodeState ahead = node, behind = node;
    ahead.x(k) += 1e-6;
    behind.x(k) -= 1e-6;
    J.col(k) = (residual(measurement, ahead) - residual(measurement, behind)) / 2e-6;
  }
  expect_close(cost.H, J.transpose() * J);
}

Lever some_lever() {
  Lever lever;
  lever << 3.0, -270.0, 290.0, -5.0, 20.0, 12.0;
  return lever;
}

TEST(FusionFactors, ALeaningFixIsPutUpright) {
  const NodeState node = some_node(1.0);
  const Eigen::Vector3d error(1.0, -2.0, 3.0);
  const PositionMeasurement measurement{node.p() + node.shared() + some_lever() * node.tilt() - error,
                                        Eigen::Matrix3d::Identity(), some_lever()};
  EXPECT_LT((residual(measurement, node) - error).norm(), 1e-9);
  expect_linearised(measurement, node);
}

TEST(FusionFactors, TheTiltSeenInTheMapIsThatOfTheBody) {
  Eigen::Matrix2d covariance;
  covariance << 4e-4, 1e-4, 1e-4, 2e-4;
  const NodeState node = some_node(1.0);
  const Eigen::Vector2d error(0.01, -0.02);
  const TiltMeasurement measurement{node.tilt() - error, sqrt_information(covariance)};
  EXPECT_NEAR(residual(measurement, node).squaredNorm(), error.dot(covariance.inverse() * error), 1e-9);
  expect_linearised(measurement, node);
}

TEST(FusionFactors, PositionIsWhitenedAndTakesTheSharedError) {
  Eigen::Matrix3d covariance;
  covariance << 4.0, 1.0, 0.2, 1.0, 9.0, -0.5, 0.2, -0.5, 2.0;
  const NodeState node = some_node(1.0);
  const Eigen::Vector3d error(1.0, -2.0, 3.0);
  const PositionMeasurement measurement{node.p() + node.shared() - error, sqrt_information(covariance)};
  EXPECT_NEAR(residual(measurement, node).squaredNorm(), error.dot(covariance.inverse() * error), 1e-9);
  const Quadratic cost = linearise(measurement, node, 1e9);
  expect_close(
      cost.b, numeric_gradient([&](const NodeState& n) { return 0.5 * residual(measurement, n).squaredNorm(); }, node));
}

TEST(FusionFactors, HuberPullsNoHarderThanItsWidth) {
  const NodeState node = some_node(1.0);
  const PositionMeasurement far{node.p() + Eigen::Vector3d(500.0, 0, 0), Eigen::Matrix3d::Identity()};
  EXPECT_NEAR(linearise(far, node, 1.5).b.head<3>().norm(), 1.5, 1e-9);
}

TEST(FusionFactors, HeadingJacobianMatchesFiniteDifferencesAndWraps) {
  HeadingMeasurement measurement{0.3, 0.05, true, Eigen::Vector3d(0.9, 0.3, 0.2).normalized()};
  const NodeState node = some_node(1.0);
  expect_close(linearise(measurement, node, 1e9).b,
               numeric_gradient([&](const NodeState& n) { return 0.5 * std::pow(residual(measurement, n), 2); }, node));
  measurement.biased = false;
  expect_close(heading_jacobian(measurement, node) / measurement.stddev,
               numeric_gradient([&](const NodeState& n) { return residual(measurement, n); }, node));
  NodeState north;
  north.x(kYaw) = M_PI_2 - 6.2;  // heading 6.2
  EXPECT_NEAR(residual(HeadingMeasurement{0.1, 1.0, true, Eigen::Vector3d::UnitX()}, north), 6.1 - 2.0 * M_PI, 1e-9);
}

TEST(FusionFactors, AnUprightAxisHasNoHeading) {
  const HeadingMeasurement upright{0.3, 0.05, true, Eigen::Vector3d::UnitZ()};
  EXPECT_EQ(heading_jacobian(upright, NodeState()).norm(), 0.0);
}

TEST(FusionFactors, PriorKeepsItsMinimumWhereverItIsLinearised) {
  Prior prior;
  const NodeState node = some_node(1.0);
  prior.point = node.x;
  StateMatrix a;
  for (int k = 0; k < a.size(); ++k) a.data()[k] = std::sin(3.1 * k);
  prior.cost.H = a * a.transpose() + StateMatrix::Identity();
  const StateVector wanted = StateVector::LinSpaced(-1.0, 1.0);
  prior.cost.b = -prior.cost.H * wanted;
  NodeState minimum = node;
  minimum.x += wanted;
  EXPECT_LT(linearise(prior, minimum).b.norm(), 1e-9);
}

}  // namespace
}  // namespace orthonav::fusion
