// The odometry's size against the true one along a flight, stretch by stretch.
#pragma once

#include <cstdint>
#include <optional>
#include <vector>

#include "tools/evaluate/flight_record.h"

namespace orthonav::evaluate {

struct ScaleError {
  double error = 0;   // odometry's displacement over the true one, less 1
  double stddev = 0;  // what the odometry said of it at the stretch's end, 1 sigma; NaN: nothing
};

// Keeps a pointer to the record.
class OdometryScale {
 public:
  static constexpr double kStretch = 10.0;  // m of true displacement: a centimetre of noise is a tenth of a percent

  explicit OdometryScale(const FlightRecord& record);

  // Of the shortest stretch of a session that ends at (begins at, or after) a time. nullopt where none is long enough.
  std::optional<ScaleError> ending_at(int64_t utime) const;
  std::optional<ScaleError> beginning_at(int64_t utime) const;

  // Of the first pose and the last one; 0 without any.
  int64_t begin() const { return poses_.empty() ? 0 : poses_.front().state->utime; }
  int64_t end() const { return poses_.empty() ? 0 : poses_.back().state->utime; }

 private:
  struct Pose {
    const vio_state_t* state;
    Eigen::Vector3d p_G_B;  // true
  };
  std::optional<ScaleError> between(const Pose& from, const Pose& to) const;

  std::vector<Pose> poses_;
};

}  // namespace orthonav::evaluate
