#include "services/fusion/node_state.h"

#include "common/math/so3.h"

namespace orthonav::fusion {
namespace {

Eigen::Vector3d rotation_vector(const Eigen::Vector2d& lean) {
  return Eigen::Vector3d(lean.x(), lean.y(), 0.0);
}

}  // namespace

Eigen::Vector2d NodeState::tilt() const {
  return Eigen::Rotation2Dd(yaw()) * lean();
}

Eigen::Quaterniond NodeState::q_G_W() const {
  return Eigen::AngleAxisd(yaw(), Eigen::Vector3d::UnitZ()) * so3_exp(rotation_vector(lean()));
}

Eigen::Matrix<double, 2, 3> tilt_jacobian(const NodeState& node) {
  const Eigen::Vector2d tilt = node.tilt();
  Eigen::Matrix<double, 2, 3> J;
  J.col(0) << -tilt.y(), tilt.x();
  J.rightCols<2>() = Eigen::Rotation2Dd(node.yaw()).toRotationMatrix();
  return J;
}

Eigen::Matrix3d rotation_jacobian(const NodeState& node) {
  const Eigen::Matrix3d Rz = Eigen::AngleAxisd(node.yaw(), Eigen::Vector3d::UnitZ()).toRotationMatrix();
  Eigen::Matrix3d J;
  J.col(0) = Eigen::Vector3d::UnitZ();
  // The left Jacobian is the right one at the opposite rotation.
  J.rightCols<2>() = (Rz * so3_right_jacobian(-rotation_vector(node.lean()))).leftCols<2>();
  return J;
}

}  // namespace orthonav::fusion
