#include "common/bus/time_guard.h"

#include "common/math/stamps.h"

namespace orthonav {

namespace {

constexpr int kAgreeing = 3;

}  // namespace

bool TimeGuard::accept(int64_t utime) {
  if (!is_stamp(utime)) return false;
  if (newest_ != 0 && of_another_time(utime, newest_)) {
    if (refused_in_a_row_ == 0 || of_another_time(utime, refused_)) {
      refused_in_a_row_ = 0;
      first_refused_ = utime;
    }
    ++refused_in_a_row_;
    refused_ = utime;
    // Neighbours are no further apart than 30 s: the difference fits.
    if (refused_in_a_row_ < kAgreeing || utime < first_refused_ || utime - first_refused_ < proof_) return false;
    newest_ = utime;
  }
  refused_in_a_row_ = 0;
  if (newest_ == 0 || utime > newest_) newest_ = utime;
  return true;
}

}  // namespace orthonav
