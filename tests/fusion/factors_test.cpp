// Jacobians of the graph's factors against central differences on the manifold.
#include "services/fusion/factors.h"

#include <memory>
#include <vector>

#include <gtest/gtest.h>

#include "common/math/so3.h"

namespace orthonav::fusion {
namespace {

NodeState some_node(double k) {
  return NodeState(Eigen::Vector3d(10.0 * k, -4.0 + k, 110.0), so3_exp(Eigen::Vector3d(0.1 * k, -0.2, 1.0 + 0.3 * k)),
                   0.02 * k);
}

Matrix6d some_covariance() {
  Matrix6d a;
  for (int i = 0; i < 36; ++i) a.data()[i] = 0.05 * std::sin(1.7 * i);
  return a * a.transpose() + 0.01 * Matrix6d::Identity();
}

void expect_jacobians_match(const ceres::CostFunction& cost, std::vector<NodeState> nodes) {
  const int rows = cost.num_residuals();
  using Padded = Eigen::Matrix<double, Eigen::Dynamic, kAmbient, Eigen::RowMajor>;
  std::vector<Padded> jacobians(nodes.size(), Padded(rows, kAmbient));
  auto evaluate = [&](const std::vector<NodeState>& at, bool with_jacobians) {
    std::vector<const double*> blocks;
    std::vector<double*> out;
    for (const NodeState& node : at) blocks.push_back(node.x.data());
    for (Padded& jacobian : jacobians) out.push_back(jacobian.data());
    Eigen::VectorXd r(rows);
    EXPECT_TRUE(cost.Evaluate(blocks.data(), r.data(), with_jacobians ? out.data() : nullptr));
    return r;
  };
  evaluate(nodes, true);
  const NodeManifold manifold;
  for (size_t block = 0; block < nodes.size(); ++block) {
    Eigen::Matrix<double, kAmbient, kTangent, Eigen::RowMajor> plus;
    manifold.PlusJacobian(nodes[block].x.data(), plus.data());
    const Eigen::MatrixXd analytic = jacobians[block] * plus;  // what Ceres makes of it
    for (int k = 0; k < kTangent; ++k) {
      const double h = 1e-6;
      auto ahead = nodes;
      auto behind = nodes;
      ahead[block] = nodes[block].plus(h * Tangent::Unit(k));
      behind[block] = nodes[block].plus(-h * Tangent::Unit(k));
      const Eigen::VectorXd numeric = (evaluate(ahead, false) - evaluate(behind, false)) / (2.0 * h);
      const double tolerance = 1e-6 * std::max(1.0, numeric.norm());
      EXPECT_LT((analytic.col(k) - numeric).norm(), tolerance) << "block " << block << ", column " << k;
    }
  }
}

TEST(FusionFactors, RelativeJacobianMatchesFiniteDifferences) {
  const RelativeFactor factor(Eigen::Vector3d(3.0, 0.5, -0.2), so3_exp(Eigen::Vector3d(0.05, 0.1, -0.4)),
                              some_covariance(), 0.01);
  expect_jacobians_match(factor, {some_node(1.0), some_node(1.4)});
}

TEST(FusionFactors, RelativeResidualIsZeroAtTheMeasuredMotionWithTheNodesScale) {
  const NodeState i = some_node(1.0);
  const Eigen::Vector3d dp(3.0, 0.5, -0.2);
  const Eigen::Quaterniond dq = so3_exp(Eigen::Vector3d(0.05, 0.1, -0.4));
  const NodeState j(i.p() + i.q() * (std::exp(i.log_scale()) * dp), i.q() * dq, i.log_scale());
  const RelativeFactor factor(dp, dq, some_covariance(), 0.01);
  const double* blocks[2] = {i.x.data(), j.x.data()};
  Tangent r;
  factor.Evaluate(blocks, r.data(), nullptr);
  EXPECT_LT(r.norm(), 1e-12);
}

TEST(FusionFactors, ResidualsAreWhitenedByTheCovariance) {
  Eigen::Matrix3d covariance;
  covariance << 4.0, 1.0, 0.2, 1.0, 9.0, -0.5, 0.2, -0.5, 2.0;
  const NodeState node = some_node(1.0);
  const Eigen::Vector3d error(1.0, -2.0, 3.0);
  const PositionFactor factor(node.p() - error, covariance);
  const double* block = node.x.data();
  Eigen::Vector3d r;
  factor.Evaluate(&block, r.data(), nullptr);
  EXPECT_NEAR(r.squaredNorm(), error.dot(covariance.inverse() * error), 1e-9);
}

TEST(FusionFactors, PositionJacobianMatchesFiniteDifferences) {
  Eigen::Matrix3d covariance;
  covariance << 4.0, 1.0, 0.2, 1.0, 9.0, -0.5, 0.2, -0.5, 2.0;
  expect_jacobians_match(PositionFactor(Eigen::Vector3d(9.0, -2.0, 100.0), covariance), {some_node(1.0)});
  expect_jacobians_match(PositionFactor(Eigen::Vector3d(9.0, -2.0, 100.0), covariance, 110.0), {some_node(1.0)});
}

TEST(FusionFactors, YawJacobianMatchesFiniteDifferencesAndWraps) {
  expect_jacobians_match(YawFactor(0.3, 0.05), {some_node(1.0)});
  const YawFactor across(-3.1, 1.0);
  const NodeState node(Eigen::Vector3d::Zero(), so3_exp(Eigen::Vector3d(0, 0, 3.1)), 0.0);
  const double* block = node.x.data();
  double r = 0;
  across.Evaluate(&block, &r, nullptr);
  EXPECT_NEAR(std::abs(r), 2.0 * M_PI - 6.2, 1e-9);
}

TEST(FusionFactors, TiltJacobianMatchesFiniteDifferences) {
  expect_jacobians_match(TiltFactor(Eigen::Vector3d(0.1, -0.05, 1.0), 0.02), {some_node(1.0)});
}

TEST(FusionFactors, PriorJacobianMatchesFiniteDifferences) {
  TangentMatrix root;
  for (int i = 0; i < 49; ++i) root.data()[i] = std::cos(2.3 * i);
  expect_jacobians_match(PriorFactor(some_node(1.0), root), {some_node(1.5)});
}

TEST(FusionFactors, PriorKeepsMinimumAndCurvatureOfItsQuadratic) {
  TangentMatrix a;
  for (int i = 0; i < 49; ++i) a.data()[i] = std::sin(3.1 * i);
  // Units as different as in a graph: metres, milliradians, permille.
  Tangent unit;
  unit << 1, 1, 1, 1e3, 1e3, 1e3, 1e3;
  const TangentMatrix H = unit.asDiagonal() * (a * a.transpose() + TangentMatrix::Identity()) * unit.asDiagonal();
  const Tangent wanted = 1e-6 * Tangent::LinSpaced(1.0, 7.0);
  const NodeState point = some_node(1.0);
  const auto prior = PriorFactor::from_quadratic(point, H, -H * wanted);
  const NodeState minimum = point.plus(wanted);
  const double* block = minimum.x.data();
  Tangent r;
  Eigen::Matrix<double, kTangent, kAmbient, Eigen::RowMajor> J;
  double* jacobian = J.data();
  prior->Evaluate(&block, r.data(), &jacobian);
  EXPECT_LT(r.norm(), 1e-6);
  Eigen::Matrix<double, kTangent, kTangent> tangent;
  tangent << J.leftCols<6>(), J.col(7);
  EXPECT_LT((tangent.transpose() * tangent - H).norm(), 1e-6 * H.norm());
}

TEST(FusionFactors, PriorAddsNothingWhereItsQuadraticKnowsNothing) {
  TangentMatrix H = TangentMatrix::Zero();
  H.topLeftCorner<3, 3>().setIdentity();  // position only
  const auto prior = PriorFactor::from_quadratic(some_node(1.0), H, Tangent::Zero());
  const NodeState turned = some_node(1.0).plus((Tangent() << 0, 0, 0, 0.5, 0.1, -0.3, 0.7).finished());
  const double* block = turned.x.data();
  Tangent r;
  prior->Evaluate(&block, r.data(), nullptr);
  EXPECT_LT(r.norm(), 1e-9);
}

TEST(NodeState, MinusUndoesPlus) {
  const Tangent delta = (Tangent() << 1.0, -2.0, 0.5, 0.3, -0.2, 2.5, 0.1).finished();
  EXPECT_LT((some_node(2.0).plus(delta).minus(some_node(2.0)) - delta).norm(), 1e-12);
}

}  // namespace
}  // namespace orthonav::fusion
