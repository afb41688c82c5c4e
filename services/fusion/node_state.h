// The variables of one node of the graph: what is unknown about the aircraft at one keyframe.
//
// The odometry knows the motion between keyframes well, and four things badly: where its world W lies on the map, how
// it is turned, its scale, and its vertical: W leans. The compass has a bias, and the map's fixes have an error that
// neighbours share (error_budget.h).
// All of it is one vector space, so a node needs no manifold: attitudes follow from it and the odometry's own,
//   R_G_B = R_G_W R_W_B,   R_G_W = Rz(yaw) Exp(lean_x, lean_y, 0).
#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>

namespace orthonav::fusion {

inline constexpr int kStates = 11;
using StateVector = Eigen::Matrix<double, kStates, 1>;
using StateMatrix = Eigen::Matrix<double, kStates, kStates>;

// Where each variable stands in the vector.
inline constexpr int kPosition = 0;     // p_G_B, m (3)
inline constexpr int kYaw = 3;          // of W in G, rad, counter-clockwise, not wrapped: the odometry's heading offset
inline constexpr int kLean = 4;         // of W, about its x and y axes, rad (2)
inline constexpr int kScale = 6;        // logarithm of true displacement over the odometry's
inline constexpr int kCompassBias = 7;  // compass's heading minus the true one, rad, clockwise
inline constexpr int kShared = 8;       // what neighbouring fixes are all off by, in G, m (3); up: the vertical offset

struct NodeState {
  StateVector x = StateVector::Zero();

  Eigen::Vector3d p() const { return x.segment<3>(kPosition); }
  double yaw() const { return x(kYaw); }
  double log_scale() const { return x(kScale); }
  double compass_bias() const { return x(kCompassBias); }
  Eigen::Vector3d shared() const { return x.segment<3>(kShared); }
  Eigen::Vector2d lean() const { return x.segment<2>(kLean); }
  // The lean about G's east and north axes, rad.
  Eigen::Vector2d tilt() const;
  Eigen::Quaterniond q_G_W() const;
};

// Derivative of tilt() with respect to (yaw, lean_x, lean_y).
Eigen::Matrix<double, 2, 3> tilt_jacobian(const NodeState& node);

// Derivative of the rotation vector e in G of R_G_W = Exp(e) R_hat with respect to (yaw, lean_x, lean_y).
Eigen::Matrix3d rotation_jacobian(const NodeState& node);

}  // namespace orthonav::fusion
