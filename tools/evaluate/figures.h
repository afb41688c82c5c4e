// Small figures that every part of the evaluation needs.
#pragma once

#include <cstdint>
#include <limits>
#include <numbers>
#include <vector>

#include "tools/evaluate/flight_record.h"

namespace orthonav::evaluate {

inline constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
inline constexpr double kDegPerRad = 180.0 / std::numbers::pi;

inline double seconds_between(int64_t from, int64_t to) {
  return 1e-6 * static_cast<double>(to - from);
}

inline double share(int part, int whole) {
  return whole > 0 ? static_cast<double>(part) / whole : kNan;
}

inline double mean(const std::vector<double>& values) {
  if (values.empty()) return kNan;
  double sum = 0;
  for (const double value : values) sum += value;
  return sum / static_cast<double>(values.size());
}

// The truth where there is one, else the GNSS reference.
inline const Reference& best_reference(const FlightRecord& record) {
  return record.truth.empty() ? record.gnss : record.truth;
}

}  // namespace orthonav::evaluate
