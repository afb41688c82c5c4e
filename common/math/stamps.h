// Time stamps that cannot belong together.
//
// A buffer ordered by time is defeated by one stamp from tomorrow: every true one after it looks old. Whoever keeps
// such a buffer forgets what is in it when a stamp of another time is let in.
#pragma once

#include <cstdint>

namespace orthonav {

inline constexpr uint64_t kAnotherTime = 30'000'000;  // microseconds: no flight is silent for so long and goes on

// Whether a clock of a flight can say so: from 1970 to 2255, where microseconds are exact in a double and differences
// fit.
inline bool is_stamp(int64_t utime) {
  return utime >= 0 && utime <= int64_t{1} << 53;
}

// Unsigned inside, because a made-up stamp may lie anywhere in 64 bits.
inline bool of_another_time(int64_t a, int64_t b) {
  const auto x = static_cast<uint64_t>(a), y = static_cast<uint64_t>(b);
  return (a > b ? x - y : y - x) > kAnotherTime;
}

}  // namespace orthonav
