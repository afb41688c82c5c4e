#include "services/fusion/node_state.h"

#include "common/math/so3.h"

namespace orthonav::fusion {

Eigen::Quaterniond NodeState::q_G_W() const {
  return Eigen::AngleAxisd(yaw(), Eigen::Vector3d::UnitZ()) * so3_exp(tilt());
}

Eigen::Matrix3d rotation_jacobian(const NodeState& node) {
  const Eigen::Matrix3d Rz = Eigen::AngleAxisd(node.yaw(), Eigen::Vector3d::UnitZ()).toRotationMatrix();
  Eigen::Matrix3d J;
  J.col(0) = Eigen::Vector3d::UnitZ();
  // The left Jacobian is the right one at the opposite rotation.
  J.rightCols<2>() = (Rz * so3_right_jacobian(-node.tilt())).leftCols<2>();
  return J;
}

}  // namespace orthonav::fusion
