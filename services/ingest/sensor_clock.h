// The two clocks between a sensor and a message's utime.
#pragma once

#include <cstdint>
#include <optional>

namespace orthonav::ingest {

// Wall time that does not jump: the machine's monotonic clock, set once by its wall clock. Whoever sets the wall clock
// in flight moves no stamp of a sensor. Thread-safe.
class HostClock {
 public:
  HostClock();
  // Microseconds since the Unix epoch.
  int64_t now() const;
  // The same from a kernel's time stamp of CLOCK_MONOTONIC, or of CLOCK_REALTIME as it goes now, in nanoseconds.
  int64_t of_monotonic(int64_t ns) const;
  int64_t of_realtime(int64_t ns) const;

 private:
  int64_t offset_;  // microseconds, wall less monotonic at the start
};

// A sensor's own clock on the host's: messages are late by a little or a lot, never early, so the least difference of
// arrival and stamp is the one to believe. It may grow by 100 parts in a million, the most that two crystals differ.
//
// At 200 Hz, a drift of 50 parts in a million and delays of 2 ms in the mean (exponential), stamps are within 0.5 ms of
// the true time plus the least delay. Not thread-safe.
class SensorClock {
 public:
  // Host's time of a message stamped `sensor_time` and heard at `arrival`, both in microseconds. The clock is set anew
  // when it does not advance with the host's: a step of 0.1 s back, as when the sensor restarts, or a jump of more than
  // 1 s.
  int64_t to_host(int64_t sensor_time, int64_t arrival);

 private:
  std::optional<double> offset_;
  int64_t last_sensor_time_ = 0;
};

}  // namespace orthonav::ingest
