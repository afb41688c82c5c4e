#include "services/fusion/node_state.h"

#include <algorithm>

#include "common/math/so3.h"

namespace orthonav::fusion {

NodeState::NodeState(const Eigen::Vector3d& p_G_B, const Eigen::Quaterniond& q_G_B, double log_scale)
    : x{p_G_B.x(), p_G_B.y(), p_G_B.z(), q_G_B.w(), q_G_B.x(), q_G_B.y(), q_G_B.z(), log_scale} {}

NodeState NodeState::plus(const Tangent& delta) const {
  const Eigen::Quaterniond q_new = (so3_exp(delta.segment<3>(3)) * q()).normalized();
  return NodeState(p() + delta.head<3>(), q_new, log_scale() + delta(6));
}

Tangent NodeState::minus(const NodeState& other) const {
  Tangent delta;
  delta << p() - other.p(), so3_log(q() * other.q().conjugate()), log_scale() - other.log_scale();
  return delta;
}

NodeState NodeState::from(const double* block) {
  NodeState node;
  std::copy_n(block, kAmbient, node.x.begin());
  return node;
}

bool NodeManifold::Plus(const double* x, const double* delta, double* x_plus_delta) const {
  const NodeState result = NodeState::from(x).plus(Eigen::Map<const Tangent>(delta));
  std::copy(result.x.begin(), result.x.end(), x_plus_delta);
  return true;
}

bool NodeManifold::PlusJacobian(const double* /*x*/, double* jacobian) const {
  Eigen::Map<Eigen::Matrix<double, kAmbient, kTangent, Eigen::RowMajor>> J(jacobian);
  J.setZero();
  J.topLeftCorner<6, 6>().setIdentity();
  J(7, 6) = 1.0;
  return true;
}

bool NodeManifold::Minus(const double* y, const double* x, double* y_minus_x) const {
  Eigen::Map<Tangent> delta(y_minus_x);
  delta = NodeState::from(y).minus(NodeState::from(x));
  return true;
}

bool NodeManifold::MinusJacobian(const double* /*x*/, double* jacobian) const {
  Eigen::Map<Eigen::Matrix<double, kTangent, kAmbient, Eigen::RowMajor>> J(jacobian);
  J.setZero();
  J.topLeftCorner<6, 6>().setIdentity();
  J(6, 7) = 1.0;
  return true;
}

}  // namespace orthonav::fusion
