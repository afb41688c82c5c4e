// How many images did not come, or not soundly or in time to be used, told by the gaps in the times of those that did:
// the bus loses an image as a whole and says nothing.
// Not thread-safe.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>

namespace orthonav::vio {

class MissedImages {
 public:
  // How many are missing before the image at `utime` (microseconds), by the median of the last nine intervals. None
  // before the first five, none where the time goes back, and none after more than two seconds, when a camera has
  // stopped or another flight has begun. A camera that slows down misses images for five of them; where more than a
  // third is lost, fewer are counted.
  int add(int64_t utime) {
    const bool follows = utime > newest_;
    const uint64_t ahead = static_cast<uint64_t>(utime) - static_cast<uint64_t>(newest_);  // a forged stamp may be any
    newest_ = utime;
    if (!follows || ahead > kLongestGap) return 0;
    const auto interval = static_cast<int64_t>(ahead);
    int missing = 0;
    if (count_ >= kLeast) {
      auto sorted = intervals_;
      const auto end = sorted.begin() + static_cast<std::ptrdiff_t>(std::min(count_, kIntervals));
      const auto middle = sorted.begin() + (end - sorted.begin()) / 2;
      std::nth_element(sorted.begin(), middle, end);
      missing = static_cast<int>((interval + *middle / 2) / *middle) - 1;
    }
    intervals_[count_++ % kIntervals] = interval;
    return std::max(missing, 0);
  }

 private:
  static constexpr size_t kIntervals = 9, kLeast = 5;
  static constexpr uint64_t kLongestGap = 2'000'000;  // microseconds
  std::array<int64_t, kIntervals> intervals_{};
  size_t count_ = 0;
  int64_t newest_ = 0;
};

}  // namespace orthonav::vio
