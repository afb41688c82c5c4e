// The motion of a multirotor as closed forms of time: what its inertial sensors feel is exact before noise.
//
// Position, yaw, wind and a small attitude jitter are splines. Tilt follows from them: the thrust, along z_B, must
// give the acceleration against gravity and the drag of the air,
//   thrust = a - g - drag (wind - v),   z_B = thrust / |thrust|,
// and x_B is the heading direction projected on the rotor plane. Frames: G (east north up, flat: gravity is along
// -z of G everywhere and the Earth does not turn) and B (x forward, y left, z up).
#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "tools/simulate/uniform_spline.h"

namespace orthonav::simulate {

struct MotionState {
  Eigen::Vector3d p_G_B = Eigen::Vector3d::Zero();  // m
  Eigen::Vector3d v_G_B = Eigen::Vector3d::Zero();  // m/s
  Eigen::Vector3d a_G_B = Eigen::Vector3d::Zero();  // m/s^2
  Eigen::Matrix3d R_G_B = Eigen::Matrix3d::Identity();
  Eigen::Vector3d angular_rate = Eigen::Vector3d::Zero();    // rad/s, of B with respect to G, in B
  Eigen::Vector3d specific_force = Eigen::Vector3d::Zero();  // m/s^2, R_G_B^T (a - g), in B

  // Angle between z_B and the vertical, rad.
  double tilt() const;
};

// Immutable; thread-safe.
class Trajectory {
 public:
  struct Parts {
    UniformSpline<3> position;  // m in G
    UniformSpline<1> yaw;       // rad, counter-clockwise from east
    UniformSpline<3> wind;      // m/s in G, of the air
    UniformSpline<3> jitter;    // rad, rotation vector in B on top of the attitude above
    double drag = 0;            // 1/s: acceleration per airspeed
    double gravity = 9.81;      // m/s^2
    double duration = 0;        // s
  };

  explicit Trajectory(Parts parts) : parts_(std::move(parts)) {}

  double duration() const { return parts_.duration; }

  // The state at t, from slightly before 0 to slightly after the duration. Throws std::out_of_range far outside.
  MotionState at(double t) const;

  // Length of the path over the duration, m, and mean tilt, rad, sampled every 0.1 s.
  double path_length() const;
  double mean_tilt() const;

 private:
  template <class T>
  Eigen::Matrix<T, 3, 3> attitude(const T& t) const;

  Parts parts_;
};

}  // namespace orthonav::simulate
