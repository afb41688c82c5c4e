// What no real input exceeds: the limits by which the fusion tells a measurement from nonsense.
#pragma once

#include <cmath>
#include <cstdint>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "common/geo/enu_frame.h"

namespace orthonav::fusion {

inline constexpr double kFarthest = 1e6;           // m: no flight leads further from its origin
inline constexpr int kLargestIdGap = 1000;         // more keyframes are not lost in a row
inline constexpr int kLargestSessionGap = 86'400;  // sessions are numbered by seconds: a day later is another flight
inline constexpr double kLargestFixStddev = 1e4;   // m, of a fix that says anything

inline constexpr double kLargestAccelBias = 10.0;  // m/s^2: as large as gravity it is no bias

inline constexpr double kLargestLevelled = 3.0;  // rad: about half a turn

inline constexpr double kLargestHeading = 13.0;  // rad, two turns: of a compass

inline constexpr double kLargestLogOdds = 1e6;

inline double seconds_between(int64_t from, int64_t to) {
  return 1e-6 * static_cast<double>(to - from);
}

inline bool is_count(int number) {
  return number >= 0 && number < 1'000'000'000;  // one more still fits
}

inline bool is_pose(const Eigen::Vector3d& p, const Eigen::Quaterniond& q) {
  return p.allFinite() && p.norm() < kFarthest && q.coeffs().allFinite() && std::abs(q.norm() - 1.0) < 1e-3;
}

// NaN is none.
inline bool is_accel_bias(const Eigen::Vector3d& bias) {
  return bias.norm() < kLargestAccelBias;
}

// Further nothing is turned to be upright; NaN is none.
inline bool is_levelled(const Eigen::Vector2d& levelled) {
  return levelled.norm() < kLargestLevelled;
}

inline bool is_place(const Geodetic& place) {
  return std::abs(place.latitude_deg) <= 90.0 && std::abs(place.longitude_deg) <= 360.0 &&
         std::abs(place.height) < 20000.0;
}

inline bool same_place(const Geodetic& a, const Geodetic& b) {
  return a.latitude_deg == b.latitude_deg && a.longitude_deg == b.longitude_deg && a.height == b.height;
}

}  // namespace orthonav::fusion
