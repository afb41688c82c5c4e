// Tells when an IMU's readings, each of them plausible by itself, are together not those of an aircraft: an axis that
// is dead, noise that no airframe makes, or a mean that nobody flies with, as a wrong unit or scale has it.
//
// The bounds are physics' and not the sensor's own past, for motors that start raise an IMU's noise twentyfold and are
// no fault. EuRoC's V1_02, a real airframe in 84 s of hard flying, repeats itself at most four times on an axis, leaps
// by 0.15 rad/s and 5.7 m/s^2 (rms in the worst half second) and keeps to 8.5-12.5 m/s^2.
#pragma once

#include <cstdint>
#include <deque>
#include <string>

#include <Eigen/Core>

#include "orthonav/imu_t.hpp"

namespace orthonav::ingest {

class ImuWatch {
 public:
  // A finite reading came at `now` (microseconds, of a clock that does not jump).
  void feed(const imu_t& reading, int64_t now);

  // What is wrong with the readings of the half second before `now`; empty when nothing is, or when they are fewer
  // than ten.
  std::string complaint(int64_t now);

 private:
  using Axes = Eigen::Matrix<double, 6, 1>;  // angular rate, rad/s; specific force, m/s^2
  struct Reading {
    int64_t time;
    Axes axes;
  };
  void forget(int64_t now);

  std::deque<Reading> recent_;
  Eigen::Matrix<int64_t, 6, 1> changed_;  // when each axis last read something else than before
  int64_t rested_ = -1'000'000;           // when the aircraft was last at rest
};

}  // namespace orthonav::ingest
