#include "services/ingest/sensor_clock.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include <time.h>

namespace orthonav::ingest {

namespace {

constexpr double kLargestDrift = 100e-6;
constexpr double kLargestJump = 1e6;      // microseconds
constexpr double kLargestDisorder = 1e5;  // microseconds that one sensor's lines may be behind another's
constexpr int kReadings = 5;
constexpr int64_t kClose = 5;  // microseconds

int64_t microseconds(clockid_t clock) {
  timespec time{};
  clock_gettime(clock, &time);
  return int64_t{time.tv_sec} * 1'000'000 + time.tv_nsec / 1000;
}

}  // namespace

HostClock::HostClock() : offset_(microseconds(CLOCK_REALTIME) - microseconds(CLOCK_MONOTONIC)) {}

int64_t HostClock::now() const {
  return microseconds(CLOCK_MONOTONIC) + offset_;
}
int64_t HostClock::of_monotonic(int64_t ns) const {
  return ns / 1000 + offset_;
}
int64_t HostClock::of_realtime(int64_t ns) const {
  // Who is put off the processor between two clocks reads them apart: the closest of some readings counts.
  int64_t closest = std::numeric_limits<int64_t>::max(), wall_less_host = 0;
  for (int i = 0; i < kReadings && closest > kClose; ++i) {
    const int64_t before = now(), wall = microseconds(CLOCK_REALTIME), after = now();
    if (after - before >= closest) continue;
    closest = after - before;
    wall_less_host = wall - before - closest / 2;
  }
  return ns / 1000 - wall_less_host;
}

int64_t SensorClock::to_host(int64_t sensor_time, int64_t arrival) {
  // As doubles: a broken stamp may be anything, and differences of microseconds below 2^53 are exact.
  const double seen = static_cast<double>(arrival) - static_cast<double>(sensor_time);
  if (offset_) {
    const double elapsed = static_cast<double>(sensor_time) - static_cast<double>(last_sensor_time_);
    const double grown = *offset_ + kLargestDrift * std::clamp(elapsed, 0.0, kLargestJump);
    const bool restarted = elapsed < -kLargestDisorder || std::abs(seen - *offset_) > kLargestJump;
    offset_ = restarted ? seen : std::min(grown, seen);
  } else {
    offset_ = seen;
  }
  last_sensor_time_ = sensor_time;
  return std::llround(static_cast<double>(sensor_time) + *offset_);
}

}  // namespace orthonav::ingest
