// How sure a place is by the fixes that agree on it: log-odds against its being wrong.
//
// The first fix is as sure as it says itself (MAP_FIX, log_odds), or as fixes are that do not say. The others are
// hardly witnesses of their own: wrong fixes come in runs, for the next field looks like this one. How far a wrong
// place moves with the aircraft is taken to have a heavy tail, for there are causes that last: beyond s it does so with
// (1 + s / wrong_distance)^-3. Two may agree by chance, however far apart: each further fix is worth one at most. A
// climb is worth nothing: a fix's height is the odometry's over whatever ground it was found above.
//
// Nothing is sure for long: once in `jump_time` an odometry jumps unnoticed, so what was known that long ago is as good
// as lost.
#pragma once

#include <cstdint>
#include <optional>

#include <Eigen/Core>

#include "services/fusion/options.h"
#include "services/fusion/types.h"

namespace orthonav::fusion {

// Logarithm of p / (1 - p).
double log_odds_of(double probability);

// A value.
class Agreement {
 public:
  Agreement() = default;
  // Of fixes that another process has seen.
  Agreement(int fixes, double most_told, double span, int64_t newest_utime);

  // `height`: of the keyframe above the ground, m.
  void add(const Keyframe& keyframe, const Fix& fix, double height, const LockOptions& options);

  int fixes() const { return fixes_; }
  double most_told() const { return most_told_; }  // the largest log-odds that one of them told; NaN: none did
  double span() const { return span_; }  // wrong distances over ground, from the first of them to the furthest
  int64_t newest_utime() const { return newest_utime_; }

  // That the place is right, told now.
  double place_log_odds(int64_t now, const LockOptions& options) const;
  // That they err by no more than they say, told now: of two sets on one place what their fixes tell of the place does
  // not count.
  double accuracy_log_odds(int64_t now, const LockOptions& options) const;

 private:
  double log_odds(double first, int64_t now, const LockOptions& options) const;

  int fixes_ = 0;
  double most_told_ = kUnknown;
  double span_ = 0;
  int64_t newest_utime_ = 0;
  std::optional<Eigen::Vector2d> first_p_W_;
};

}  // namespace orthonav::fusion
