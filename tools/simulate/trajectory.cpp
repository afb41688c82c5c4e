#include "tools/simulate/trajectory.h"

#include <cmath>

#include <ceres/jet.h>
#include <ceres/rotation.h>

namespace orthonav::simulate {
namespace {

constexpr double kStatisticsStep = 0.1;  // s

}  // namespace

double MotionState::tilt() const {
  return std::acos(std::min(1.0, R_G_B(2, 2)));
}

template <class T>
Eigen::Matrix<T, 3, 3> Trajectory::attitude(const T& t) const {
  using std::cos;
  using std::sin;
  using Vector = Eigen::Matrix<T, 3, 1>;
  const Vector v = parts_.position.evaluate(t, 1);
  const Vector a = parts_.position.evaluate(t, 2);
  const Vector wind = parts_.wind.evaluate(t);
  const Vector gravity(T(0.0), T(0.0), T(-parts_.gravity));
  const Vector thrust = a - gravity - (wind - v) * T(parts_.drag);
  const T yaw = parts_.yaw.evaluate(t)[0];
  const Vector course(cos(yaw), sin(yaw), T(0.0));
  Eigen::Matrix<T, 3, 3> R;
  R.col(2) = thrust / thrust.norm();
  const Vector left = R.col(2).cross(course);
  R.col(1) = left / left.norm();
  R.col(0) = R.col(1).cross(R.col(2));
  const Vector jitter = parts_.jitter.evaluate(t);
  Eigen::Matrix<T, 3, 3> R_jitter;
  ceres::AngleAxisToRotationMatrix(jitter.data(), R_jitter.data());
  return R * R_jitter;
}

MotionState Trajectory::at(double t) const {
  MotionState state;
  state.p_G_B = parts_.position.evaluate(t);
  state.v_G_B = parts_.position.evaluate(t, 1);
  state.a_G_B = parts_.position.evaluate(t, 2);
  using Jet = ceres::Jet<double, 1>;
  const Eigen::Matrix<Jet, 3, 3> R = attitude(Jet(t, 0));
  Eigen::Matrix3d R_dot;
  for (int i = 0; i < 9; ++i) {
    state.R_G_B(i) = R(i).a;
    R_dot(i) = R(i).v[0];
  }
  const Eigen::Matrix3d rate = state.R_G_B.transpose() * R_dot;  // skew-symmetric
  state.angular_rate = 0.5 * Eigen::Vector3d(rate(2, 1) - rate(1, 2), rate(0, 2) - rate(2, 0), rate(1, 0) - rate(0, 1));
  state.specific_force = state.R_G_B.transpose() * (state.a_G_B + Eigen::Vector3d(0, 0, parts_.gravity));
  return state;
}

double Trajectory::path_length() const {
  const auto steps = static_cast<int>(std::ceil(parts_.duration / kStatisticsStep));
  const double step = parts_.duration / steps;
  double length = 0;
  for (int i = 0; i < steps; ++i) length += step * parts_.position.evaluate((i + 0.5) * step, 1).norm();
  return length;
}

double Trajectory::mean_tilt() const {
  const auto steps = static_cast<int>(std::ceil(parts_.duration / kStatisticsStep));
  const double step = parts_.duration / steps;
  double sum = 0;
  for (int i = 0; i < steps; ++i) sum += std::acos(std::min(1.0, attitude((i + 0.5) * step)(2, 2)));
  return sum / steps;
}

}  // namespace orthonav::simulate
