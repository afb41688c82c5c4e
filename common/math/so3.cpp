#include "common/math/so3.h"

#include <cmath>

namespace orthonav {

namespace {
constexpr double kSmallAngle = 1e-5;
}

Eigen::Matrix3d skew(const Eigen::Vector3d& a) {
  Eigen::Matrix3d m;
  m << 0, -a.z(), a.y(), a.z(), 0, -a.x(), -a.y(), a.x(), 0;
  return m;
}

Eigen::Quaterniond so3_exp(const Eigen::Vector3d& phi) {
  const double angle = phi.norm();
  if (angle < kSmallAngle) {
    const Eigen::Vector3d half = 0.5 * (1.0 - angle * angle / 24.0) * phi;
    return Eigen::Quaterniond(1.0 - angle * angle / 8.0, half.x(), half.y(), half.z()).normalized();
  }
  const Eigen::Vector3d v = std::sin(0.5 * angle) / angle * phi;
  return {std::cos(0.5 * angle), v.x(), v.y(), v.z()};
}

Eigen::Vector3d so3_log(const Eigen::Quaterniond& q) {
  const double sign = q.w() < 0 ? -1.0 : 1.0;
  const Eigen::Vector3d v = sign * q.vec();
  const double w = sign * q.w();
  const double n = v.norm();
  if (n < kSmallAngle) return (2.0 / w - 2.0 * n * n / (3.0 * w * w * w)) * v;
  return 2.0 * std::atan2(n, w) / n * v;
}

Eigen::Matrix3d so3_right_jacobian(const Eigen::Vector3d& phi) {
  const double a = phi.norm();
  const Eigen::Matrix3d K = skew(phi);
  if (a < kSmallAngle) return Eigen::Matrix3d::Identity() - 0.5 * K + K * K / 6.0;
  return Eigen::Matrix3d::Identity() - (1.0 - std::cos(a)) / (a * a) * K + (a - std::sin(a)) / (a * a * a) * K * K;
}

Eigen::Matrix3d so3_right_jacobian_inverse(const Eigen::Vector3d& phi) {
  const double a = phi.norm();
  const Eigen::Matrix3d K = skew(phi);
  if (a < kSmallAngle) return Eigen::Matrix3d::Identity() + 0.5 * K + K * K / 12.0;
  // cot(a/2)/2 instead of (1 + cos a)/(2 sin a): finite at a = pi.
  return Eigen::Matrix3d::Identity() + 0.5 * K + (1.0 - 0.5 * a / std::tan(0.5 * a)) / (a * a) * K * K;
}

double yaw_of(const Eigen::Quaterniond& q) {
  return std::atan2(2.0 * (q.w() * q.z() + q.x() * q.y()), 1.0 - 2.0 * (q.y() * q.y() + q.z() * q.z()));
}

double wrap_angle(double angle) {
  const double wrapped = std::remainder(angle, 2.0 * M_PI);
  return wrapped <= -M_PI ? wrapped + 2.0 * M_PI : wrapped;
}

double heading_of(const Eigen::Quaterniond& q_ENU_B) {
  const double heading = M_PI_2 - yaw_of(q_ENU_B);
  const double wrapped = std::fmod(heading, 2.0 * M_PI);
  return wrapped < 0 ? wrapped + 2.0 * M_PI : wrapped;
}

}  // namespace orthonav
