#include "common/bus/nav_guard.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <numbers>

namespace orthonav {

namespace {

constexpr double kLongestGap = 2;      // s; after it any place is believed
constexpr double kHighestSpeed = 150;  // m/s
constexpr double kCorrection = 50;     // m: what a fix may correct at once
constexpr double kWidest = 100;        // m: a position less certain is none (fusion calls it LOST)
constexpr int64_t kResetsMissed = 3;   // states with the resets between may be lost
constexpr double kMetresPerDegree = 111'320;

bool plausible(const nav_state_t& state) {
  const auto within = [](double value, double low, double high) { return value >= low && value <= high; };  // no NaN
  return within(state.latitude_deg, -90, 90) && within(state.longitude_deg, -180, 180) &&
         within(state.ellipsoidal_height, -1'000, 100'000) && within(state.covariance[0], 0, 1e12) &&
         within(state.covariance[7], 0, 1e12) && within(state.covariance[14], 0, 1e12);
}

}  // namespace

const char* NavGuard::refusal(const nav_state_t& state) {
  if (std::isnan(state.latitude_deg)) return nullptr;
  if (!plausible(state)) return "implausible";
  // In doubles: a forged stamp may be any.
  const double seconds =
      last_ ? 1e-6 * std::abs(static_cast<double>(state.utime) - static_cast<double>(last_->utime)) : kLongestGap + 1;
  if (seconds <= kLongestGap) {
    const int64_t resets = int64_t{state.reset_counter} - last_->reset_counter;
    const double east = std::remainder(state.longitude_deg - last_->longitude_deg, 360.0) *
                        std::cos(last_->latitude_deg * std::numbers::pi / 180);
    const double moved = kMetresPerDegree * std::hypot(state.latitude_deg - last_->latitude_deg, east);
    const bool flown = moved <= kCorrection + kHighestSpeed * seconds + 5 * last_->stddev;
    if (!flown && (resets < 1 || resets > kResetsMissed)) return "jump";
  }
  const double stddev = std::min(kWidest, std::sqrt(state.covariance[0] + state.covariance[7]));
  last_ = {state.utime, state.latitude_deg, state.longitude_deg, stddev, state.reset_counter};
  return nullptr;
}

}  // namespace orthonav
