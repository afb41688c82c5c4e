// Rotations: the exponential map of SO(3) and its Jacobians.
//
// Hamilton quaternions; vectors in radians. All functions are pure and thread-safe, and accurate
// through zero rotation (series below 1e-5 rad).
#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>

namespace orthonav {

// The matrix with skew(a) * b = a x b.
Eigen::Matrix3d skew(const Eigen::Vector3d& a);

// Rotation by |phi| about phi.
Eigen::Quaterniond so3_exp(const Eigen::Vector3d& phi);

// Inverse of so3_exp, with |result| <= pi. `q` need not have positive w.
Eigen::Vector3d so3_log(const Eigen::Quaterniond& q);

// J_r with exp(phi + d) = exp(phi) exp(J_r(phi) d) to first order.
Eigen::Matrix3d so3_right_jacobian(const Eigen::Vector3d& phi);

// Inverse of so3_right_jacobian; |phi| < 2 pi.
Eigen::Matrix3d so3_right_jacobian_inverse(const Eigen::Vector3d& phi);

// Yaw of R: the rotation about z in R = Rz(yaw) Ry(pitch) Rx(roll), rad in (-pi, pi].
double yaw_of(const Eigen::Quaterniond& q);

// Angle wrapped to (-pi, pi].
double wrap_angle(double angle);

// Clockwise heading from north of the body's x axis, rad in [0, 2 pi), for an attitude with
// respect to east-north-up.
double heading_of(const Eigen::Quaterniond& q_ENU_B);

}  // namespace orthonav
