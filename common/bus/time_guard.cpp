#include "common/bus/time_guard.h"

namespace orthonav {

namespace {

constexpr uint64_t kLongestJump = 30'000'000;  // microseconds
constexpr int kAgreeing = 3;

// Unsigned, because a made-up stamp may lie anywhere in 64 bits.
bool near(int64_t a, int64_t b) {
  const auto x = static_cast<uint64_t>(a), y = static_cast<uint64_t>(b);
  return (a > b ? x - y : y - x) <= kLongestJump;
}

}  // namespace

bool TimeGuard::accept(int64_t utime) {
  if (newest_ != 0 && !near(utime, newest_)) {
    refused_in_a_row_ = refused_in_a_row_ > 0 && near(utime, refused_) ? refused_in_a_row_ + 1 : 1;
    refused_ = utime;
    if (refused_in_a_row_ < kAgreeing) return false;
    newest_ = utime;
  }
  refused_in_a_row_ = 0;
  if (newest_ == 0 || utime > newest_) newest_ = utime;
  return true;
}

}  // namespace orthonav
