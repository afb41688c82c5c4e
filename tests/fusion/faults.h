// What can go wrong in flight, done to a synthetic one. Times in s from its start.
#pragma once

#include <algorithm>
#include <cmath>
#include <map>

#include "common/geo/enu_frame.h"
#include "common/math/so3.h"
#include "tests/fusion/synthetic_flight.h"

namespace orthonav::fusion::faults {

inline bool within(const SyntheticFlight& flight, int64_t utime, double from, double to) {
  const double t = 1e-6 * static_cast<double>(utime - flight.states.front().utime);
  return t >= from && t < to;
}

// Fixes are off by this much, m, east north up, plus a drift, m/s.
inline void shift_fixes(SyntheticFlight& flight, double from, double to, const Eigen::Vector3d& offset,
                        const Eigen::Vector3d& drift = Eigen::Vector3d::Zero()) {
  const EnuFrame frame(flight.anchor);
  for (size_t k = 0; k < flight.fixes.size(); ++k) {
    Fix& fix = flight.fixes[k];
    if (!within(flight, fix.utime, from, to)) continue;
    const double t = 1e-6 * static_cast<double>(fix.utime - flight.states.front().utime) - from;
    fix.position = frame.to_geodetic(frame.to_enu(fix.position) + offset + t * drift);
    flight.wrong[k] = true;
  }
}

inline void erase(SyntheticFlight& flight, SyntheticFlight::Step::Kind kind, double from, double to) {
  std::erase_if(flight.steps, [&](const SyntheticFlight::Step& step) {
    if (step.kind != kind) return false;
    const int64_t utime =
        kind == SyntheticFlight::Step::Kind::kFix ? flight.fixes[step.index].utime : flight.compass[step.index].utime;
    return within(flight, utime, from, to);
  });
}

inline void silence_fixes(SyntheticFlight& flight, double from, double to) {
  erase(flight, SyntheticFlight::Step::Kind::kFix, from, to);
}
inline void silence_compass(SyntheticFlight& flight, double from, double to) {
  erase(flight, SyntheticFlight::Step::Kind::kCompass, from, to);
}

// The inertial sensor says nothing.
inline void silence_imu(SyntheticFlight& flight, double from, double to) {
  std::erase_if(flight.steps, [&](const SyntheticFlight::Step& step) {
    return step.kind == SyntheticFlight::Step::Kind::kImu && within(flight, flight.imu[step.index].utime, from, to);
  });
}

// The compass, and the headings of fixes that come from it.
inline void turn_compass(SyntheticFlight& flight, double from, double to, double angle) {
  for (CompassReading& reading : flight.compass) {
    if (within(flight, reading.utime, from, to)) reading.heading += angle;
  }
  for (Fix& fix : flight.fixes) {
    if (within(flight, fix.utime, from, to)) fix.heading += angle;
  }
}
inline void freeze_compass(SyntheticFlight& flight, double from) {
  double frozen = std::nan("");
  for (CompassReading& reading : flight.compass) {
    if (!within(flight, reading.utime, from, 1e9)) continue;
    if (std::isnan(frozen)) frozen = reading.heading;
    reading.heading = frozen;
  }
}

// From then on the odometry's way is `scale` times as long, turned by `yaw` (rad) and moved by `jump` (m, in W).
inline void bend_odometry(SyntheticFlight& flight, double from, double scale, double yaw,
                          const Eigen::Vector3d& jump = Eigen::Vector3d::Zero()) {
  const Eigen::Quaterniond turn(Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()));
  const auto first = std::find_if(flight.states.begin(), flight.states.end(),
                                  [&](const OdometryState& state) { return within(flight, state.utime, from, 1e9); });
  if (first == flight.states.end()) return;
  const Eigen::Vector3d origin = first->p_W_B;
  const auto bend = [&](auto& pose) {
    if (!within(flight, pose.utime, from, 1e9)) return;
    pose.p_W_B = origin + jump + scale * (turn * (pose.p_W_B - origin));
    pose.q_W_B = turn * pose.q_W_B;
  };
  for (OdometryState& state : flight.states) {
    if (within(flight, state.utime, from, 1e9)) state.v_W_B = scale * (turn * state.v_W_B);
    bend(state);
  }
  for (Keyframe& keyframe : flight.keyframes) bend(keyframe);
}

// The odometry begins a new session, in a world of its own, and has no pose for `gap` seconds.
inline void restart_odometry(SyntheticFlight& flight, double at, double gap) {
  const Eigen::Quaterniond turn(Eigen::AngleAxisd(2.1, Eigen::Vector3d::UnitZ()));
  const Eigen::Vector3d move(40.0, -70.0, 12.0);
  const auto renew = [&](auto& pose) {
    if (!within(flight, pose.utime, at, 1e9)) return;
    pose.session += 1;
    pose.p_W_B = turn * pose.p_W_B + move;
    pose.q_W_B = turn * pose.q_W_B;
  };
  for (OdometryState& state : flight.states) {
    if (within(flight, state.utime, at, 1e9)) state.v_W_B = turn * state.v_W_B;
    if (within(flight, state.utime, at, at + gap)) state.has_pose = false;
    renew(state);
  }
  std::map<int, int> ids;  // keyframes of the new session count from 0
  for (Keyframe& keyframe : flight.keyframes) {
    renew(keyframe);
    if (!within(flight, keyframe.utime, at + gap, 1e9)) continue;
    const int id = static_cast<int>(ids.size());
    ids[keyframe.id] = id;
    keyframe.id = id;
  }
  for (Fix& fix : flight.fixes) {
    if (!within(flight, fix.utime, at + gap, 1e9)) continue;
    fix.keyframe_id = ids.at(fix.keyframe_id);
    fix.session += 1;
  }
  std::erase_if(flight.steps, [&](const SyntheticFlight::Step& step) {
    if (step.kind == SyntheticFlight::Step::Kind::kKeyframe) {
      return within(flight, flight.keyframes[step.index].utime, at, at + gap);
    }
    return step.kind == SyntheticFlight::Step::Kind::kFix &&
           within(flight, flight.fixes[step.index].utime, at, at + gap);
  });
}

}  // namespace orthonav::fusion::faults
