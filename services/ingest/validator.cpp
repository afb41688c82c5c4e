#include "services/ingest/validator.h"

#include <cmath>

#include <fmt/format.h>

namespace orthonav::ingest {

namespace {

constexpr double kLongestJump = 3600.0;  // s
constexpr double kGapPeriods = 3.0;
// Three times what the sensors of a small aircraft can read: 35 rad/s, 160 m/s^2, 1 mT (the Earth's field is 0.05).
constexpr double kFastestTurn = 100;      // rad/s
constexpr double kLargestForce = 500;     // m/s^2
constexpr double kStrongestField = 3e-3;  // T
constexpr double kLargestHeading = 13;    // rad, two turns
constexpr double kHighest = 20'000;       // m
// A clock that was set back stays back: after so many refusals in a row its new time is taken over.
constexpr int kRefusalsUntilNewTime = 50;

// What is wrong with a message by itself; reason and detail, both empty when nothing is.
struct Fault {
  const char* reason = "";
  std::string detail;
};

struct FaultOf {
  Fault operator()(const imu_t& m) const {
    for (int i = 0; i < 3; ++i) {
      if (!std::isfinite(m.angular_rate[i])) return {"nan", fmt::format("angular_rate[{}] is not finite", i)};
      if (!std::isfinite(m.specific_force[i])) return {"nan", fmt::format("specific_force[{}] is not finite", i)};
      if (std::abs(m.angular_rate[i]) > kFastestTurn)
        return {"range", fmt::format("angular_rate[{}] is {:.0f} rad/s", i, m.angular_rate[i])};
      if (std::abs(m.specific_force[i]) > kLargestForce)
        return {"range", fmt::format("specific_force[{}] is {:.0f} m/s^2", i, m.specific_force[i])};
    }
    return {};
  }
  Fault operator()(const image_t& m) const {
    if (m.width <= 0 || m.height <= 0) return {"size", fmt::format("image of {}x{} pixels", m.width, m.height)};
    if (m.size != static_cast<int32_t>(m.data.size()) || m.size == 0)
      return {"size", fmt::format("{} bytes of data", m.size)};
    if (m.pixelformat == image_t::PIXEL_FORMAT_GRAY) {
      if (m.row_stride < m.width || int64_t{m.row_stride} * m.height > m.size) {
        return {"size", fmt::format("{} bytes are too few for {} rows of {}", m.size, m.height, m.row_stride)};
      }
    } else if (m.pixelformat != image_t::PIXEL_FORMAT_MJPEG) {
      return {"format", fmt::format("pixel format {} is neither GRAY nor MJPEG", m.pixelformat)};
    }
    return {};
  }
  Fault operator()(const compass_t& m) const {
    if (!std::isfinite(m.heading)) return {"nan", "heading is not finite"};
    if (std::abs(m.heading) > kLargestHeading) return {"range", fmt::format("heading is {:.0f} rad", m.heading)};
    return {};
  }
  Fault operator()(const magnetometer_t& m) const {
    for (const double component : m.field) {
      if (!std::isfinite(component)) return {"nan", "field is not finite"};
      if (std::abs(component) > kStrongestField) return {"range", fmt::format("field of {:.3g} T", component)};
    }
    return {};
  }
  Fault operator()(const altitude_t& m) const {
    if (!std::isfinite(m.height_above_ground)) return {"nan", "height_above_ground is not finite"};
    if (std::abs(m.height_above_ground) > kHighest)
      return {"range", fmt::format("height_above_ground is {:.0f} m", m.height_above_ground)};
    return {};
  }
  Fault operator()(const gnss_reference_t& m) const {
    return std::isfinite(m.latitude_deg + m.longitude_deg + m.ellipsoidal_height)
               ? Fault{}
               : Fault{"nan", "position is not finite"};
  }
  Fault operator()(const truth_t& m) const {
    return std::isfinite(m.latitude_deg + m.longitude_deg + m.ellipsoidal_height)
               ? Fault{}
               : Fault{"nan", "position is not finite"};
  }
};

}  // namespace

Verdict Validator::check(const SensorMessage& message) {
  const char* channel = channel_of(message);
  const int64_t utime = utime_of(message);
  Stream& stream = streams_[channel];
  const auto refuse = [&](const char* reason, const std::string& detail) {
    return Verdict{false, reason, fmt::format("{} at {}: {}", channel, utime, detail), false};
  };
  if (const Fault fault = std::visit(FaultOf{}, message); *fault.reason != '\0')
    return refuse(fault.reason, fault.detail);
  if (utime <= 0) return refuse("order", "time stamp is not positive");

  Verdict verdict;
  if (stream.last_utime != 0) {
    const double elapsed = static_cast<double>(utime - stream.last_utime) * 1e-6;
    const bool backwards = elapsed <= 0, jump = std::abs(elapsed) > kLongestJump;
    if ((backwards || jump) && ++stream.refused_in_a_row < kRefusalsUntilNewTime) {
      return backwards && !jump ? refuse("order", fmt::format("{:.6f} s before the message before it", -elapsed))
                                : refuse("jump", fmt::format("{:.0f} s from the message before it", elapsed));
    }
    if (!backwards && !jump) {
      verdict.gap = stream.period > 0 && elapsed > kGapPeriods * stream.period;
      if (!verdict.gap) stream.period = stream.period > 0 ? 0.95 * stream.period + 0.05 * elapsed : elapsed;
    }
  }
  stream.refused_in_a_row = 0;
  stream.last_utime = utime;
  return verdict;
}

double Validator::rate_hz(const std::string& channel) const {
  const auto it = streams_.find(channel);
  return it == streams_.end() || it->second.period <= 0 ? 0.0 : 1.0 / it->second.period;
}

}  // namespace orthonav::ingest
