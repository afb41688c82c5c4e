#include "services/fusion/fusion.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include <Eigen/Cholesky>

#include "common/math/so3.h"
#include "common/math/stamps.h"
#include "services/fusion/plausible.h"

namespace orthonav::fusion {
namespace {

constexpr int64_t kCompassNear = 250'000;  // microseconds: a reading further away says nothing of a keyframe
constexpr size_t kCompassMemory = 500;     // readings: a keyframe may come this late

}  // namespace

const char* to_string(Outcome outcome) {
  switch (outcome) {
    case Outcome::kUsed:
      return "used";
    case Outcome::kWaiting:
      return "waiting";
    case Outcome::kLocked:
      return "locked";
    case Outcome::kRelocked:
      return "relocked";
    case Outcome::kOutlier:
      return "outlier";
    case Outcome::kBadNumber:
      return "bad_number";
    case Outcome::kUnknownKeyframe:
      return "unknown_keyframe";
    case Outcome::kTooLate:
      return "too_late";
    case Outcome::kOldSession:
      return "old_session";
    case Outcome::kDuplicate:
      return "duplicate";
    case Outcome::kOutOfOrder:
      return "out_of_order";
    case Outcome::kJump:
      return "jump";
  }
  return "unknown";
}

Fusion::Fusion(const FusionOptions& options) : options_(options), inertial_(options.inertial), modes_(options) {}

void Fusion::start_segment(int session) {
  session_ = session;
  to_confirm_ = 0;
  waypoints_.clear();
  fixed_.clear();
  if (graph_) before_ = newest_;
  graph_.reset();
  waiting_.clear();
  forget_rival();
  believed_ = {};
  confirming_ = {};
  tilted_from_.reset();
  num_fixes_ = 0;
  session_utime_ = 0;
  last_state_.reset();
  bridge_.reset();
  // The inertial sensor may still carry the position; what is given out does not jump then.
  if (!inertial_.newest()) leave_map();
}

void Fusion::forget_rival() {
  rival_.reset();
  rival_is_likelier_ = false;
}

void Fusion::leave_map() {
  astray_.reset();
  frame_.reset();
  inertial_.invalidate();
  last_located_.reset();
  newest_fix_utime_ = 0;
  if (!has_output_ || is_loss_counted_) return;
  ++reset_counter_;
  is_loss_counted_ = true;
}

Outcome Fusion::add_keyframe(const Keyframe& keyframe) {
  if (!is_pose(keyframe.p_W_B, keyframe.q_W_B) || !is_levelled(keyframe.levelled) || keyframe.session < 0 ||
      keyframe.id < 0) {
    return Outcome::kBadNumber;
  }
  go_on(keyframe.session, keyframe.utime, keyframe.p_W_B);
  if (keyframe.session < session_) return Outcome::kOldSession;
  if (keyframe.session > session_) {
    if (session_ > 0 && keyframe.session - session_ > kLargestSessionGap) return Outcome::kBadNumber;
    start_segment(keyframe.session);
  }
  Outcome outcome = Outcome::kUsed;
  if (!waypoints_.empty()) {
    const Keyframe& newest = waypoints_.rbegin()->second.keyframe;
    const double duration = seconds_between(newest.utime, keyframe.utime);
    if (keyframe.id <= newest.id) return Outcome::kDuplicate;
    if (keyframe.id - newest.id > kLargestIdGap || duration <= 0.0) return Outcome::kBadNumber;
    if ((keyframe.p_W_B - newest.p_W_B).norm() > options_.max_speed * duration) {
      start_segment(session_);
      outcome = Outcome::kJump;
    }
  }
  Waypoint waypoint{keyframe, compass_near(keyframe.utime)};
  Keyframe& clean = waypoint.keyframe;
  clean.q_W_B.normalize();
  clean.lean_stddev = last_state_ ? last_state_->lean_stddev : kUnknown;
  // A covariance that is none would break the graph: better to know nothing.
  const Eigen::LLT<Matrix6d> llt(clean.relative_covariance);
  if (!clean.relative_covariance.allFinite() || llt.info() != Eigen::Success) {
    clean.relative_covariance.setConstant(kUnknown);
  }
  if (session_utime_ == 0) session_utime_ = clean.utime;
  if (graph_ && astray_) {
    const double off = astray_variance(clean.utime, last_state_ ? last_state_->v_W_B : Eigen::Vector3d::Zero());
    clean.astray_variance = std::max(0.0, off - astray_->in_graph);
    if (!std::exchange(astray_->turn_in_graph, true)) clean.astray_turn = kAnyHeading * kAnyHeading;
    astray_->in_graph += clean.astray_variance;
  }
  waypoints_.emplace_hint(waypoints_.end(), clean.id, waypoint);
  if (graph_) {
    append(waypoint);
    graph_->settle_newest();
    update_newest();
  } else {
    try_bridge();
  }
  if (options_.window_keyframes > 0) {
    while (static_cast<int>(waypoints_.size()) > options_.window_keyframes) {
      fixed_.erase(waypoints_.begin()->first);
      waypoints_.erase(waypoints_.begin());
    }
  }
  return outcome;
}

std::optional<Memory> Fusion::memory() const {
  if (!graph_) return std::nullopt;
  Memory memory;
  memory.keyframe = graph_->newest();
  memory.session_utime = session_utime_;
  memory.estimate = newest_;
  memory.anchor = frame_->anchor();
  memory.newest_fix_utime = newest_fix_utime_;
  memory.believed = believed_.fixes();
  memory.most_told = believed_.most_told();
  memory.span = believed_.span();
  memory.reset_counter = reset_counter_;
  return memory;
}

bool Fusion::resume(const Memory& memory) {
  const Keyframe& keyframe = memory.keyframe;
  const Estimate& estimate = memory.estimate;
  const bool counts =
      is_count(memory.believed) && is_count(memory.reset_counter) && is_count(keyframe.id) && keyframe.session > 0;
  const bool times = is_stamp(keyframe.utime) && is_stamp(memory.session_utime) && is_stamp(memory.newest_fix_utime);
  const bool numbers = is_pose(keyframe.p_W_B, keyframe.q_W_B) && is_place(memory.anchor) &&
                       estimate.state.x.allFinite() && estimate.state.p().norm() < kFarthest &&
                       std::abs(estimate.state.log_scale()) < 1.0 && estimate.covariance.allFinite() &&
                       is_levelled(keyframe.levelled) && memory.span >= 0.0 && memory.span < kFarthest &&
                       !(std::abs(memory.most_told) > kLargestLogOdds);
  if (!counts || !times || !numbers || estimate.covariance.llt().info() != Eigen::Success) return false;
  memory_ = memory;
  return true;
}

// With the first message of the odometry.
void Fusion::go_on(int session, int64_t utime, const Eigen::Vector3d& p_W_B) {
  if (!memory_) return;
  const Memory memory = *memory_;
  memory_.reset();
  const Keyframe& keyframe = memory.keyframe;
  const double age = seconds_between(keyframe.utime, utime);
  const bool continues = session == keyframe.session && age >= 0.0 && age <= options_.memory_age &&
                         (p_W_B - keyframe.p_W_B).norm() <= options_.max_speed * std::max(1e-3, age);
  if (!continues) {
    // What comes has nothing to do with the positions that were given out before.
    reset_counter_ = memory.reset_counter + 1;
    is_loss_counted_ = true;
    return;
  }
  session_ = session;
  session_utime_ = memory.session_utime;
  reset_counter_ = memory.reset_counter;
  newest_fix_utime_ = memory.newest_fix_utime;
  believed_ = Agreement(memory.believed, memory.most_told, memory.span, memory.newest_fix_utime);
  to_confirm_ = 1;
  frame_.emplace(memory.anchor);
  waypoints_.emplace(keyframe.id, Waypoint{keyframe, std::nullopt});
  fixed_.emplace(keyframe.id, keyframe.utime);  // a fix of it may be in there already
  graph_ = std::make_unique<PoseGraph>(options_);
  graph_->start(keyframe, memory.estimate);
  // Where the newest tilt in there was seen is not known any more: here, at the latest.
  tilted_from_ = keyframe.p_W_B;
  update_newest();
}

Outcome Fusion::add_compass(const CompassReading& reading) {
  // Whatever range headings are given in, they are of one turn or two.
  if (!(std::abs(reading.heading) <= kLargestHeading)) return Outcome::kBadNumber;
  if (reading.heading_stddev > kLargestHeading) return Outcome::kBadNumber;
  if (!compass_.empty() && of_another_time(reading.utime, compass_.back().utime)) compass_.clear();
  if (!compass_.empty() && reading.utime <= compass_.back().utime) return Outcome::kOutOfOrder;
  CompassReading turned = reading;
  turned.heading = true_heading(reading.heading, options_.declination);
  compass_.push_back(turned);
  if (compass_.size() > kCompassMemory) compass_.pop_front();
  return Outcome::kUsed;
}

std::optional<CompassReading> Fusion::compass_near(int64_t utime) const {
  const auto after = std::lower_bound(compass_.begin(), compass_.end(), utime,
                                      [](const CompassReading& reading, int64_t t) { return reading.utime < t; });
  std::optional<CompassReading> best;
  int64_t distance = kCompassNear + 1;
  for (const auto& candidate : {after, after == compass_.begin() ? after : std::prev(after)}) {
    if (candidate == compass_.end() || std::abs(candidate->utime - utime) >= distance) continue;
    distance = std::abs(candidate->utime - utime);
    best = *candidate;
  }
  return best;
}

// A session's scale is settled when the odometry has seen some acceleration.
double Fusion::scale_stddev_at(const Keyframe& keyframe) const {
  const EdgeOptions& edge = options_.edge;
  const double age = std::max(0.0, seconds_between(session_utime_, keyframe.utime));
  const double left = std::exp(-age / edge.scale_time);
  return std::hypot(edge.scale_stddev, left * edge.start_scale_stddev);
}

double Fusion::compass_noise(const CompassReading& reading) const {
  // What a reading says of itself includes the bias, which is a state of its own.
  const CompassOptions& compass = options_.compass;
  const double more = std::isfinite(reading.heading_stddev) ? reading.heading_stddev : 0.0;
  const double beyond = std::max(0.0, more * more - compass.bias_stddev * compass.bias_stddev);
  return std::sqrt(compass.noise_stddev * compass.noise_stddev + beyond);
}

void Fusion::append(const Waypoint& waypoint) {
  graph_->append(waypoint.keyframe);
  if (!waypoint.compass) return;
  const double noise = compass_noise(*waypoint.compass);
  const Estimate estimate = graph_->estimate(waypoint.keyframe.id);
  const HeadingMeasurement measurement{waypoint.compass->heading, noise, true,
                                       waypoint.keyframe.q_W_B * Eigen::Vector3d::UnitX()};
  const StateVector J = heading_jacobian(measurement, estimate.state);
  const double predicted = J.dot(estimate.covariance * J);
  const double innovation = noise * residual(measurement, estimate.state);
  if (std::abs(innovation) > options_.compass.innovation * std::sqrt(predicted + noise * noise)) {
    ++compass_rejected_;
    return;
  }
  graph_->add_compass(waypoint.keyframe.id, measurement.heading, noise);
}

double Fusion::scale() const {
  return graph_ ? std::exp(newest_.state.log_scale()) : kUnknown;
}

}  // namespace orthonav::fusion
