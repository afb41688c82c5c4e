#include "services/registration/heading_buffer.h"

#include <algorithm>
#include <cmath>

#include "common/math/so3.h"
#include "common/math/stamps.h"

namespace orthonav::registration {

bool HeadingBuffer::add(int64_t utime, const Heading& heading) {
  if (!std::isfinite(heading.value) || !std::isfinite(heading.stddev) || !(heading.stddev >= 0)) return false;
  if (!samples_.empty() && of_another_time(utime, samples_.back().utime)) samples_.clear();
  if (!samples_.empty() && utime <= samples_.back().utime) return false;
  samples_.push_back({utime, heading});
  if (samples_.size() > kCapacity) samples_.pop_front();
  return true;
}

std::optional<Heading> HeadingBuffer::at(int64_t utime) const {
  const auto after = std::lower_bound(samples_.begin(), samples_.end(), utime,
                                      [](const Sample& sample, int64_t time) { return sample.utime < time; });
  const bool has_after = after != samples_.end() && after->utime - utime <= max_gap_;
  const bool has_before = after != samples_.begin() && utime - std::prev(after)->utime <= max_gap_;
  if (has_after && has_before) {
    const Sample& a = *std::prev(after);
    const double part = static_cast<double>(utime - a.utime) / static_cast<double>(after->utime - a.utime);
    const double step = wrap_angle(after->heading.value - a.heading.value);
    const double stddev = (1 - part) * a.heading.stddev + part * after->heading.stddev;
    return Heading{wrap_angle(a.heading.value + part * step), stddev};
  }
  if (has_after) return after->heading;
  if (has_before) return std::prev(after)->heading;
  return std::nullopt;
}

}  // namespace orthonav::registration
