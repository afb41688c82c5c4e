// The compass around the time of a keyframe.
#pragma once

#include <cstdint>
#include <deque>
#include <optional>

#include "services/registration/types.h"

namespace orthonav::registration {

class HeadingBuffer {
 public:
  // `max_gap` in microseconds: a sample further than this from a time says nothing of it.
  explicit HeadingBuffer(int64_t max_gap) : max_gap_(max_gap) {}

  // Times must grow: a sample not newer than the last is refused (false), as is one that is not finite. One of another
  // time (stamps.h) takes the place of all before.
  bool add(int64_t utime, const Heading& heading);

  // Whether at() cannot improve by waiting: there is a sample at or after the time.
  bool covers(int64_t utime) const { return !samples_.empty() && samples_.back().utime >= utime; }

  // Interpolated the short way round between the samples before and after; beyond the ends the nearest. nullopt when
  // the samples needed are further than max_gap.
  std::optional<Heading> at(int64_t utime) const;

 private:
  struct Sample {
    int64_t utime;
    Heading heading;
  };
  static constexpr size_t kCapacity = 1000;
  int64_t max_gap_;
  std::deque<Sample> samples_;
};

}  // namespace orthonav::registration
