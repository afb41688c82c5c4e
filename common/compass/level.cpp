#include "common/compass/level.h"

#include <algorithm>
#include <cmath>

#include "common/math/so3.h"

namespace orthonav {

namespace {

constexpr double kTimeConstant = 5.0;   // s
constexpr double kGravity = 9.81;       // m/s^2
constexpr double kGravityWithin = 0.5;  // m/s^2
constexpr double kLongestGap = 1.0;     // s

}  // namespace

void Level::feed(int64_t utime, const Eigen::Vector3d& angular_rate, const Eigen::Vector3d& specific_force) {
  if (!angular_rate.allFinite() || !specific_force.allFinite() || !(specific_force.norm() > 0)) return;
  const double dt = static_cast<double>(utime - utime_) * 1e-6;
  if (up_B_ && dt <= 0) return;
  utime_ = utime;
  const Eigen::Vector3d measured = specific_force.normalized();
  if (!up_B_ || dt > kLongestGap) {
    up_B_ = measured;
    return;
  }
  *up_B_ = so3_exp(-angular_rate * dt) * *up_B_;
  if (std::abs(specific_force.norm() - kGravity) < kGravityWithin) {
    *up_B_ += std::min(1.0, dt / kTimeConstant) * (measured - *up_B_);
  }
  up_B_->normalize();
}

}  // namespace orthonav
