// The variables of one node of the graph: pose in G, equation (11), and the odometry's scale there.
#pragma once

#include <array>

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <ceres/manifold.h>

namespace orthonav::fusion {

// Tangent of a node: (position 3, rotation vector 3, logarithm of scale 1). Rotations are perturbed on the left,
// R = Exp(e) R_hat, so the rotation vector is in G, as in nav_state_t.
inline constexpr int kTangent = 7;
inline constexpr int kAmbient = 8;
using Tangent = Eigen::Matrix<double, kTangent, 1>;
using TangentMatrix = Eigen::Matrix<double, kTangent, kTangent>;

// A node as one parameter block of Ceres: p (3), q as w x y z (4), log scale (1). True displacement = exp(log
// scale) times the odometry's: a monocular odometry's scale is wrong by some percent and drifts slowly.
struct NodeState {
  std::array<double, kAmbient> x{0, 0, 0, 1, 0, 0, 0, 0};

  NodeState() = default;
  NodeState(const Eigen::Vector3d& p_G_B, const Eigen::Quaterniond& q_G_B, double log_scale);

  Eigen::Vector3d p() const { return Eigen::Vector3d(x[0], x[1], x[2]); }
  Eigen::Quaterniond q() const { return Eigen::Quaterniond(x[3], x[4], x[5], x[6]); }
  double log_scale() const { return x[7]; }

  NodeState plus(const Tangent& delta) const;
  // The delta with other.plus(delta) == *this.
  Tangent minus(const NodeState& other) const;
  // Reads a parameter block.
  static NodeState from(const double* block);
};

// Tells Ceres about the tangent space. The cost functions here give Jacobians with respect to the tangent, padded
// to the ambient size: column 6 is zero and column 7 is the log scale. PlusJacobian picks the seven others.
class NodeManifold final : public ceres::Manifold {
 public:
  int AmbientSize() const override { return kAmbient; }
  int TangentSize() const override { return kTangent; }
  bool Plus(const double* x, const double* delta, double* x_plus_delta) const override;
  bool PlusJacobian(const double* x, double* jacobian) const override;
  bool Minus(const double* y, const double* x, double* y_minus_x) const override;
  bool MinusJacobian(const double* x, double* jacobian) const override;
};

}  // namespace orthonav::fusion
