// Which way is up, from gyroscope and accelerometer: all that a compass needs of the attitude.
//
// A complementary filter of the up vector in B: turned by the gyroscope, pulled towards the specific force with a time
// constant of 5 s while its length is within 0.5 m/s^2 of gravity. A long coordinated turn leans it (5 m/s on a circle
// of 30 m: 5 degrees in the end); a gyroscope bias of 0.2 degrees/s by 1 degree.
#pragma once

#include <cstdint>
#include <optional>

#include <Eigen/Core>

namespace orthonav {

class Level {
 public:
  // angular_rate in rad/s and specific_force in m/s^2, in B, in time order; what is not finite or goes back in time is
  // passed over. After a gap of more than 1 s it starts afresh.
  void feed(int64_t utime, const Eigen::Vector3d& angular_rate, const Eigen::Vector3d& specific_force);

  // Unit vector up in B, nullopt before the first sample.
  const std::optional<Eigen::Vector3d>& up_B() const { return up_B_; }

 private:
  std::optional<Eigen::Vector3d> up_B_;
  int64_t utime_ = 0;
};

}  // namespace orthonav
