#include "services/fusion/fusion.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <utility>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

#include "common/math/so3.h"

namespace orthonav::fusion {
namespace {

constexpr double kFarthest = 1e6;    // m: no flight leads further from its origin
constexpr int kLargestIdGap = 1000;  // more keyframes are not lost in a row
constexpr int kLargestSessionGap =
    86'400;                             // sessions are numbered by seconds: a day later is another flight, or nonsense
constexpr double kLargestStddev = 1e4;  // m, of a fix that says anything

double seconds_between(int64_t from, int64_t to) {
  return 1e-6 * static_cast<double>(to - from);
}

bool is_rotation(const Eigen::Quaterniond& q) {
  return std::abs(q.norm() - 1.0) < 1e-3;
}

bool is_pose(const Eigen::Vector3d& p, const Eigen::Quaterniond& q) {
  return p.allFinite() && p.norm() < kFarthest && q.coeffs().allFinite() && is_rotation(q);
}

bool is_place(const Geodetic& place) {
  return std::abs(place.latitude_deg) <= 90.0 && std::abs(place.longitude_deg) <= 360.0 &&
         std::abs(place.height) < 20000.0;
}

bool same_place(const Geodetic& a, const Geodetic& b) {
  return a.latitude_deg == b.latitude_deg && a.longitude_deg == b.longitude_deg && a.height == b.height;
}

double yaw_from_heading(double heading) {
  return wrap_angle(0.5 * std::numbers::pi - heading);
}

// Yaw of the body's x axis, as a compass would see it.
double axis_yaw(const Eigen::Quaterniond& q) {
  return yaw_from_heading(heading_of(q));
}

// Covariance with each axis no better than its floor; nullopt when it is none.
std::optional<Eigen::Matrix3d> floored(const Eigen::Matrix3d& covariance, const FixOptions& options) {
  const Eigen::Vector3d floor(options.horizontal_stddev_floor, options.horizontal_stddev_floor,
                              options.vertical_stddev_floor);
  const Eigen::Matrix3d added = floor.cwiseAbs2().asDiagonal();
  if (covariance.hasNaN()) {
    return Eigen::Matrix3d(Eigen::Matrix3d::Identity() * options.default_stddev * options.default_stddev);
  }
  const Eigen::Matrix3d symmetric = 0.5 * (covariance + covariance.transpose());
  if (!(covariance - symmetric).isZero(1e-6 * covariance.norm() + 1e-12)) return std::nullopt;
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> eigen(symmetric, Eigen::EigenvaluesOnly);
  if (!(eigen.eigenvalues().minCoeff() >= 0.0)) return std::nullopt;
  if (!(eigen.eigenvalues().maxCoeff() < kLargestStddev * kLargestStddev)) return std::nullopt;
  return Eigen::Matrix3d(symmetric + added);
}

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
    case Outcome::kJump:
      return "jump";
  }
  return "unknown";
}

Fusion::Fusion(const FusionOptions& options) : options_(options) {}

void Fusion::start_segment(int session) {
  session_ = session;
  keyframes_.clear();
  fixed_.clear();
  frame_.reset();
  graph_.reset();
  memory_.clear();
  accepted_.clear();
  num_fixes_ = 0;
  newest_fix_utime_ = 0;
  last_state_.reset();
  if (has_output_) ++reset_counter_;
}

Outcome Fusion::add_keyframe(const Keyframe& keyframe) {
  if (!is_pose(keyframe.p_W_B, keyframe.q_W_B) || keyframe.session < 0 || keyframe.id < 0) return Outcome::kBadNumber;
  if (keyframe.session < session_) return Outcome::kOldSession;
  if (keyframe.session > session_) {
    if (session_ > 0 && keyframe.session - session_ > kLargestSessionGap) return Outcome::kBadNumber;
    start_segment(keyframe.session);
  }
  Outcome outcome = Outcome::kUsed;
  if (!keyframes_.empty()) {
    const Keyframe& newest = keyframes_.rbegin()->second;
    const double duration = seconds_between(newest.utime, keyframe.utime);
    if (keyframe.id <= newest.id) return Outcome::kDuplicate;
    if (keyframe.id - newest.id > kLargestIdGap || duration <= 0.0) return Outcome::kBadNumber;
    if ((keyframe.p_W_B - newest.p_W_B).norm() > options_.max_speed * duration) {
      start_segment(session_);
      outcome = Outcome::kJump;
    }
  }
  Keyframe clean = keyframe;
  clean.q_W_B.normalize();
  // A covariance that is none would break the graph: better to know nothing.
  const Eigen::LLT<Matrix6d> llt(clean.relative_covariance);
  if (!clean.relative_covariance.allFinite() || llt.info() != Eigen::Success) {
    clean.relative_covariance.setConstant(kUnknown);
  }
  keyframes_.emplace_hint(keyframes_.end(), clean.id, clean);
  if (graph_) graph_->append(clean);
  if (options_.window_keyframes > 0) {
    while (static_cast<int>(keyframes_.size()) > options_.window_keyframes) {
      fixed_.erase(keyframes_.begin()->first);
      keyframes_.erase(keyframes_.begin());
    }
  }
  return outcome;
}

std::optional<Sighting> Fusion::sight(const Fix& fix, Outcome& refused) const {
  refused = Outcome::kBadNumber;
  if (!is_place(fix.position) || !is_place(fix.anchor) || !std::isfinite(fix.heading)) return std::nullopt;
  const auto covariance = floored(fix.covariance, options_.fix);
  if (!covariance) return std::nullopt;
  if (fix.session != session_) {
    refused = fix.session < session_ ? Outcome::kOldSession : Outcome::kUnknownKeyframe;
    return std::nullopt;
  }
  const auto found = keyframes_.find(fix.keyframe_id);
  if (found == keyframes_.end()) {
    const bool gone = !keyframes_.empty() && fix.keyframe_id < keyframes_.begin()->first;
    refused = gone ? Outcome::kTooLate : Outcome::kUnknownKeyframe;
    return std::nullopt;
  }
  if (found->second.utime != fix.utime) return std::nullopt;
  if (fixed_.count(fix.keyframe_id) > 0) {
    refused = Outcome::kDuplicate;
    return std::nullopt;
  }
  Sighting sighting;
  sighting.keyframe = found->second;
  sighting.fix = fix;
  sighting.covariance = *covariance;
  sighting.yaw_G_W = wrap_angle(yaw_from_heading(fix.heading) - axis_yaw(sighting.keyframe.q_W_B));
  sighting.yaw_stddev = fix.heading_stddev > 0.0 ? fix.heading_stddev : options_.fix.default_heading_stddev;
  return sighting;
}

Outcome Fusion::add_fix(const Fix& fix) {
  Outcome refused = Outcome::kBadNumber;
  std::optional<Sighting> sighting = sight(fix, refused);
  if (!sighting) return refused;
  fixed_.emplace(fix.keyframe_id, fix.utime);
  if (!graph_) {
    remember(*sighting, false);
    return try_lock() ? Outcome::kLocked : Outcome::kWaiting;
  }
  if (!graph_->contains(fix.keyframe_id)) return Outcome::kTooLate;
  sighting->p_G_B = frame_->to_enu(fix.position);
  if (!within_gate(*sighting)) {
    remember(*sighting, false);
    return try_relock() ? Outcome::kRelocked : Outcome::kOutlier;
  }
  remember(*sighting, true);
  use(*sighting);
  solve_and_watch_for_jump();
  return Outcome::kUsed;
}

void Fusion::remember(const Sighting& sighting, bool accepted) {
  memory_.push_back(sighting);
  accepted_.push_back(accepted);
  if (static_cast<int>(memory_.size()) > options_.gate.memory) {
    memory_.erase(memory_.begin());
    accepted_.erase(accepted_.begin());
  }
}

bool Fusion::try_lock() {
  // G is the newest fix's: another map may have been loaded since the older ones.
  const Geodetic& anchor = memory_.back().fix.anchor;
  if (!frame_ || !same_place(frame_->anchor(), anchor)) frame_.emplace(anchor);
  for (Sighting& sighting : memory_) sighting.p_G_B = frame_->to_enu(sighting.fix.position);
  return lock_on_consensus(static_cast<size_t>(options_.gate.lock_fixes));
}

bool Fusion::try_relock() {
  const auto accepted = std::count(accepted_.begin(), accepted_.end(), true);
  return lock_on_consensus(static_cast<size_t>(std::max<int64_t>(options_.gate.relock_fixes, accepted + 1)));
}

bool Fusion::lock_on_consensus(size_t needed) {
  const auto consensus = find_consensus(memory_, needed, options_.gate.agreement, options_.edge.scale_stddev);
  if (!consensus || consensus->members.size() <= consensus->rivals) return false;
  // Only fixes that are not believed speak against the ones that are: a fix at the edge of the gate agrees with many
  // believed ones and proves nothing.
  const auto against = std::count_if(consensus->members.begin(), consensus->members.end(),
                                     [this](size_t index) { return !accepted_[index]; });
  if (static_cast<size_t>(against) < needed) return false;
  std::vector<Sighting> members;
  std::fill(accepted_.begin(), accepted_.end(), false);
  for (const size_t index : consensus->members) {
    members.push_back(memory_[index]);
    accepted_[index] = true;
  }
  lock(members);
  return true;
}

void Fusion::lock(const std::vector<Sighting>& members) {
  const Placement placement = place(members);
  const Eigen::Quaterniond q_G_W(Eigen::AngleAxisd(placement.yaw_G_W, Eigen::Vector3d::UnitZ()));
  graph_ = std::make_unique<PoseGraph>(options_);
  // Keyframes before the first fix add nothing that is known about the newest one.
  auto next = keyframes_.find(members.front().keyframe.id);
  if (next == keyframes_.end()) next = keyframes_.begin();
  graph_->start(next->second, q_G_W * next->second.p_W_B + placement.p_G_W, q_G_W * next->second.q_W_B);
  while (++next != keyframes_.end()) graph_->append(next->second);

  num_fixes_ = 0;
  newest_fix_utime_ = 0;
  const Sighting& last = members.back();
  // Once, not at every fix: their headings share the compass's bias.
  graph_->add_yaw(last.keyframe.id, wrap_angle(placement.yaw_G_W + axis_yaw(last.keyframe.q_W_B)), last.yaw_stddev);
  for (const Sighting& member : members) {
    if (graph_->contains(member.keyframe.id)) use(member);
  }
  graph_->solve();
  ++reset_counter_;
}

bool Fusion::within_gate(const Sighting& sighting) const {
  const int id = sighting.keyframe.id;
  const NodeState& state = graph_->state(id);
  Eigen::Vector3d innovation = sighting.p_G_B - state.p();
  if (options_.fix.height_from_odometry && std::isfinite(sighting.keyframe.height_above_ground)) {
    innovation.z() += (std::exp(state.log_scale()) - 1.0) * sighting.keyframe.height_above_ground;
  }
  const Eigen::Matrix3d covariance = graph_->covariance(id).topLeftCorner<3, 3>() + sighting.covariance;
  const double limit = options_.gate.innovation * options_.gate.innovation;
  return innovation.dot(covariance.ldlt().solve(innovation)) < limit;
}

void Fusion::use(const Sighting& sighting) {
  graph_->add_position(sighting.keyframe.id, sighting.p_G_B, sighting.covariance);
  ++num_fixes_;
  newest_fix_utime_ = std::max(newest_fix_utime_, sighting.fix.utime);
}

void Fusion::solve_and_watch_for_jump() {
  const int newest = graph_->newest().id;
  const Eigen::Vector3d before = graph_->state(newest).p();
  graph_->solve();
  if ((graph_->state(newest).p() - before).norm() > options_.reset_jump) ++reset_counter_;
}

double Fusion::scale() const {
  return graph_ ? std::exp(graph_->state(graph_->newest().id).log_scale()) : kUnknown;
}

Fusion::Propagated Fusion::propagate(const OdometryState& state) {
  Propagated result;
  result.solution.utime = state.utime;
  result.solution.session = session_;
  result.solution.reset_counter = reset_counter_;
  if (state.session < session_) {
    result.outcome = Outcome::kOldSession;
    return result;
  }
  if (state.session > session_) {
    if (session_ > 0 && state.session - session_ > kLargestSessionGap) {
      result.outcome = Outcome::kBadNumber;
      return result;
    }
    start_segment(state.session);
    result.solution.session = session_;
    result.solution.reset_counter = reset_counter_;
  }
  if (!state.has_pose) return result;
  if (!is_pose(state.p_W_B, state.q_W_B)) {
    result.outcome = Outcome::kBadNumber;
    return result;
  }
  const std::optional<OdometryState> last = std::exchange(last_state_, state);
  if (last) {
    const double duration = std::max(1e-3, std::abs(seconds_between(last->utime, state.utime)));
    if ((state.p_W_B - last->p_W_B).norm() > options_.max_speed * duration) {
      result.outcome = Outcome::kJump;
      return result;
    }
  }
  has_output_ = true;
  if (graph_) {
    result.solution = located(state, result.solution);
    return result;
  }
  result.solution.mode = Mode::kDeadReckoning;
  result.solution.p_G_B = state.p_W_B;
  result.solution.v_G_B = state.v_W_B;
  result.solution.q_G_B = state.q_W_B.normalized();
  return result;
}

Solution Fusion::located(const OdometryState& state, Solution solution) const {
  const Keyframe& keyframe = graph_->newest();
  const NodeState& node = graph_->state(keyframe.id);
  const double scale = std::exp(node.log_scale());
  const Eigen::Quaterniond q_G_W = node.q() * keyframe.q_W_B.conjugate();
  const Eigen::Vector3d moved = scale * (q_G_W * (state.p_W_B - keyframe.p_W_B));
  solution.p_G_B = node.p() + moved;
  solution.v_G_B = scale * (q_G_W * state.v_W_B);
  solution.q_G_B = (q_G_W * state.q_W_B).normalized();

  Eigen::Matrix<double, 6, kTangent> J = Eigen::Matrix<double, 6, kTangent>::Zero();
  J.topLeftCorner<6, 6>().setIdentity();
  J.block<3, 3>(0, 3) = -skew(moved);
  J.block<3, 1>(0, 6) = moved;
  const double duration = std::abs(seconds_between(keyframe.utime, state.utime));
  // Isotropic, so that it is the same in B and in G.
  solution.covariance =
      J * graph_->covariance(keyframe.id) * J.transpose() + edge_covariance(options_.edge, moved.norm(), duration);

  solution.anchor = frame_->anchor();
  solution.position = frame_->to_geodetic(solution.p_G_B);
  solution.time_since_fix = seconds_between(newest_fix_utime_, state.utime);
  solution.num_fixes = num_fixes_;
  solution.mode = solution.time_since_fix > options_.coasting_after ? Mode::kCoasting : Mode::kMapAided;
  return solution;
}

}  // namespace orthonav::fusion
