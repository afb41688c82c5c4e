// The part of Fusion that decides which fixes to believe.
#include <algorithm>
#include <cmath>
#include <numbers>
#include <utility>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

#include "common/math/so3.h"
#include "services/fusion/error_budget.h"
#include "services/fusion/fusion.h"
#include "services/fusion/plausible.h"

namespace orthonav::fusion {
namespace {

// Standard deviation of a position on the map of which nothing is known, m.
constexpr double kAnywhere = 1e4;
// Log-odds against another place from which on it is not reckoned with: what a level has left for a fault.
const double kNoDoubt = log_odds_of(1.0 - kFaultProbability);
// Newest fixes not believed that are searched for agreement.
constexpr size_t kWaiting = 100;
// Share of a new measurement below which it waits for more: hovering, the same ground is seen for ever.
constexpr double kNoNews = 1e-3;

double yaw_from_heading(double heading) {
  return wrap_angle(0.5 * std::numbers::pi - heading);
}

// What the fix does not share with its neighbours; nullopt when its covariance is none.
std::optional<Eigen::Matrix3d> own_covariance(const Eigen::Matrix3d& covariance, const FixOptions& options) {
  if (covariance.hasNaN()) {
    return Eigen::Matrix3d(Eigen::Matrix3d::Identity() * options.default_stddev * options.default_stddev);
  }
  const Eigen::Matrix3d symmetric = 0.5 * (covariance + covariance.transpose());
  if (!(covariance - symmetric).isZero(1e-6 * covariance.norm() + 1e-12)) return std::nullopt;
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> eigen(symmetric, Eigen::EigenvaluesOnly);
  if (!(eigen.eigenvalues().minCoeff() >= 0.0)) return std::nullopt;
  if (!(eigen.eigenvalues().maxCoeff() < kLargestFixStddev * kLargestFixStddev)) return std::nullopt;
  return Eigen::Matrix3d(symmetric + options.stddev_floor * options.stddev_floor * Eigen::Matrix3d::Identity());
}

bool makes_sense(const Upright& upright) {
  return upright.p_G_B.norm() < kLargestFixStddev && upright.lever.norm() < kFarthest &&
         upright.tilt.norm() < kFarthest && upright.tilt_covariance.allFinite() &&
         Eigen::LLT<Eigen::Matrix2d>(upright.tilt_covariance).info() == Eigen::Success;
}

}  // namespace

std::optional<Sighting> Fusion::sight(const Fix& fix, Outcome& refused) const {
  refused = Outcome::kBadNumber;
  if (!is_place(fix.position) || !is_place(fix.anchor) || !std::isfinite(fix.heading)) return std::nullopt;
  if (std::abs(fix.log_odds) > kLargestLogOdds) return std::nullopt;
  const auto covariance = own_covariance(fix.upright ? fix.upright->covariance : fix.covariance, options_.fix);
  if (!covariance || (fix.upright && !makes_sense(*fix.upright))) return std::nullopt;
  if (fix.session != session_) {
    refused = fix.session < session_ ? Outcome::kOldSession : Outcome::kUnknownKeyframe;
    return std::nullopt;
  }
  const auto found = waypoints_.find(fix.keyframe_id);
  if (found == waypoints_.end()) {
    const bool gone = !waypoints_.empty() && fix.keyframe_id < waypoints_.begin()->first;
    refused = gone ? Outcome::kTooLate : Outcome::kUnknownKeyframe;
    return std::nullopt;
  }
  const Keyframe& keyframe = found->second.keyframe;
  if (keyframe.utime != fix.utime) return std::nullopt;
  if (fixed_.count(fix.keyframe_id) > 0) {
    refused = Outcome::kDuplicate;
    return std::nullopt;
  }
  Sighting sighting;
  sighting.keyframe = keyframe;
  sighting.fix = fix;
  sighting.covariance = *covariance;
  sighting.lever = fix.upright ? fix.upright->lever : lever_of_height(working_height(options_.edge, keyframe));
  sighting.scale_stddev = scale_stddev_at(keyframe);
  sighting.yaw_G_W = wrap_angle(yaw_from_heading(fix.heading) - yaw_from_heading(heading_of(keyframe.q_W_B)));
  const double stddev = fix.heading_stddev > 0.0 ? fix.heading_stddev : options_.compass.fix_stddev;
  sighting.yaw_stddev = fix.heading_fitted ? stddev : std::max(stddev, options_.compass.bias_stddev);
  return sighting;
}

Outcome Fusion::add_fix(const Fix& fix) {
  Outcome refused = Outcome::kBadNumber;
  std::optional<Sighting> sighting = sight(fix, refused);
  if (!sighting) return refused;
  fixed_.emplace(fix.keyframe_id, fix.utime);
  const auto wait = [&] {
    waiting_.push_back(*sighting);
    if (waiting_.size() > kWaiting) waiting_.erase(waiting_.begin());
  };
  if (!graph_) {
    wait();
    return try_lock() ? Outcome::kLocked : Outcome::kWaiting;
  }
  if (!graph_->contains(fix.keyframe_id)) return Outcome::kTooLate;
  sighting->place_in(*frame_);
  if (!within_gate(*sighting)) {
    wait();
    return try_relock() ? Outcome::kRelocked : Outcome::kOutlier;
  }
  use(*sighting);
  solve_and_watch_for_jump();
  return Outcome::kUsed;
}

bool Fusion::try_lock() {
  // G is the newest fix's: another map may have been loaded since the older ones.
  const Geodetic& anchor = waiting_.back().fix.anchor;
  if (!frame_ || !same_place(frame_->anchor(), anchor)) frame_.emplace(anchor);
  for (Sighting& sighting : waiting_) sighting.place_in(*frame_);
  const double sure = log_odds_of(options_.lock.probability);
  const auto consensus = find_consensus(waiting_, sure, options_);
  if (!consensus || consensus->log_odds(options_) < sure) return false;
  const std::vector<Sighting> members = those_of(*consensus);
  for (size_t k = consensus->members.size(); k-- > 0;) {
    waiting_.erase(waiting_.begin() + static_cast<std::ptrdiff_t>(consensus->members[k]));
  }
  lock(members);
  return true;
}

std::vector<Sighting> Fusion::those_of(const Consensus& consensus) const {
  std::vector<Sighting> members;
  for (const size_t index : consensus.members) members.push_back(waiting_[index]);
  return members;
}

// Where the fixes that are not believed agree to be, against where the solution is: part of the protection level while
// it may be so, the mode says LOST when it is likelier, and when it is sure the solution is moved there.
bool Fusion::try_relock() {
  const Sighting& last = waiting_.back();
  const int64_t now = last.fix.utime;
  const NodeState& here = graph_->state(last.keyframe.id);
  // Upright, as the graph takes its fixes.
  const Eigen::Vector3d offset = last.p_G_B - last.lever * here.tilt() - here.p();
  const bool is_elsewhere = offset.head<2>().norm() > kPlaceSize;
  const auto log_odds = [&](const Agreement& agreement) {
    return is_elsewhere ? agreement.place_log_odds(now, options_.lock)
                        : agreement.accuracy_log_odds(now, options_.lock);
  };
  const double ours = log_odds(believed_);
  const auto consensus = find_consensus(waiting_, ours - kNoDoubt, options_);
  if (!consensus) return false;
  const double theirs = log_odds(consensus->agreement);
  const double odds = theirs - ours;
  const double against_all = odds - std::log1p(std::exp(consensus->rival_log_odds));
  if (against_all >= log_odds_of(options_.lock.probability)) {
    const std::vector<Sighting> members = those_of(*consensus);
    waiting_.clear();
    const Estimate left = newest_;
    lock(members);
    // The place that is left may have been right.
    reckon_with({left.state.p() - newest_.state.p(), left.covariance.block<3, 3>(kPosition, kPosition)}, now, ours);
    return true;
  }
  if (odds < -kNoDoubt) return false;
  // As an offset: it is carried along with the newest node.
  rival_is_likelier_ = odds > 0.0;
  reckon_with({offset, last.covariance + shared_covariance(options_, last.keyframe, last.lever)}, now, theirs);
  return false;
}

void Fusion::reckon_with(const Located& rival, int64_t utime, double log_odds) {
  rival_ = rival;
  rival_utime_ = utime;
  rival_log_odds_ = log_odds;
  update_newest();
}

void Fusion::lock(const std::vector<Sighting>& members) {
  const Placement placement = place(members);
  const Eigen::Quaterniond q_G_W(Eigen::AngleAxisd(placement.yaw_G_W, Eigen::Vector3d::UnitZ()));
  // Keyframes before the first fix add nothing that is known about the newest one.
  auto next = waypoints_.find(members.front().keyframe.id);
  if (next == waypoints_.end()) next = waypoints_.begin();
  NodeState guess;
  guess.x.segment<3>(kPosition) = q_G_W * next->second.keyframe.p_W_B + placement.p_G_W;
  guess.x(kYaw) = placement.yaw_G_W;
  StateVector stddev;
  const double scale_stddev = scale_stddev_at(next->second.keyframe);
  // The fixes' heading is the compass's, which has its own term in the graph.
  const double yaw_stddev = next->second.compass ? kAnyHeading : members.back().yaw_stddev;
  const double lean_stddev = stddev_of_lean(options_.edge, next->second.keyframe);
  stddev << kAnywhere, kAnywhere, kAnywhere, yaw_stddev, lean_stddev, lean_stddev, scale_stddev,
      options_.compass.bias_stddev, shared_stddev(options_.fix);
  graph_ = std::make_unique<PoseGraph>(options_);
  graph_->start(next->second.keyframe, guess, stddev);
  for (;;) {
    // Before the fixes have turned the graph there is no test that a reading could fail.
    const Waypoint& waypoint = next->second;
    if (waypoint.compass) {
      graph_->add_compass(waypoint.keyframe.id, waypoint.compass->heading, compass_noise(*waypoint.compass));
    }
    if (++next == waypoints_.end()) break;
    graph_->append(next->second.keyframe);
  }

  num_fixes_ = 0;
  believed_ = {};
  confirming_ = {};
  to_confirm_ = 0;
  newest_fix_utime_ = 0;
  forget_rival();
  tilted_from_.reset();
  for (const Sighting& member : members) {
    if (graph_->contains(member.keyframe.id)) use(member);
  }
  graph_->solve();
  update_newest();
  if (!std::exchange(is_loss_counted_, false)) ++reset_counter_;
  ++moves_;
}

bool Fusion::within_gate(const Sighting& sighting) const {
  const Estimate estimate = graph_->estimate(sighting.keyframe.id);
  const PositionMeasurement measurement{sighting.p_G_B, Eigen::Matrix3d::Identity(), sighting.lever};
  const Eigen::Vector3d innovation = residual(measurement, estimate.state);
  const PositionRows J = position_jacobian(sighting.lever, estimate.state);
  const Eigen::Matrix3d covariance = J * estimate.covariance * J.transpose() + sighting.covariance;
  const double limit = options_.lock.innovation * options_.lock.innovation;
  return innovation.dot(covariance.llt().solve(innovation)) < limit;
}

// The slope of the same ground seen again is no news: of a constant error that is forgotten over some way, a sample at
// that way's share from the last tells as much as one in coth(share / 2) would that errs by itself. A wood's edge may
// be taken for a slope, the position right all the same: a tilt that the graph cannot have is left out.
void Fusion::add_tilt(const Sighting& sighting) {
  if (!sighting.fix.upright) return;
  const Upright& upright = *sighting.fix.upright;
  const Estimate estimate = graph_->estimate(sighting.keyframe.id);
  const Eigen::Matrix<double, 2, 3> J = tilt_jacobian(estimate.state);
  const Eigen::Matrix2d covariance =
      J * estimate.covariance.block<3, 3>(kYaw, kYaw) * J.transpose() + upright.tilt_covariance;
  const Eigen::Vector2d innovation = upright.tilt - estimate.state.tilt();
  const double limit = options_.lock.innovation * options_.lock.innovation;
  if (!(innovation.dot(covariance.llt().solve(innovation)) < limit)) return;
  const Eigen::Vector3d& p_W_B = sighting.keyframe.p_W_B;
  const double forgotten = options_.fix.tilt_distance * working_height(options_.edge, sighting.keyframe);
  const double news = tilted_from_ ? std::tanh(0.5 * (p_W_B - *tilted_from_).head<2>().norm() / forgotten) : 1.0;
  if (news < kNoNews) return;
  tilted_from_ = p_W_B;
  graph_->add_tilt(sighting.keyframe.id, upright.tilt, upright.tilt_covariance / news);
}

void Fusion::use(const Sighting& sighting) {
  const int id = sighting.keyframe.id;
  const Fix& fix = sighting.fix;
  graph_->add_position(id, sighting.p_G_B, sighting.covariance, sighting.lever);
  add_tilt(sighting);
  // So that neighbours that look at the same points do not count as if each looked at its own.
  const double shared = std::sqrt(static_cast<double>(std::max(1, fix.num_keyframes)));
  if (fix.heading_fitted && fix.heading_stddev > 0.0) {
    const double stddev = std::hypot(fix.heading_stddev, options_.fix.heading_stddev_floor);
    graph_->add_map_heading(id, fix.heading, shared * stddev);
  }
  if (fix.scale > 0.1 && fix.scale < 10.0 && fix.scale_stddev > 0.0) {
    const double stddev = std::hypot(fix.scale_stddev / fix.scale, options_.fix.scale_stddev_floor);
    graph_->add_scale(id, std::log(fix.scale), shared * stddev);
  }
  ++num_fixes_;
  newest_fix_utime_ = std::max(newest_fix_utime_, sighting.fix.utime);
  // One of before the way was lost says nothing of where it has led.
  if (!astray_ || sighting.keyframe.utime > astray_->utime) believe(sighting);
}

void Fusion::believe(const Sighting& sighting) {
  const double height = working_height(options_.edge, sighting.keyframe);
  believed_.add(sighting.keyframe, sighting.fix, height, options_.lock);
  confirming_.add(sighting.keyframe, sighting.fix, height, options_.lock);
  to_confirm_ = std::max(0, to_confirm_ - 1);
  if (to_confirm_ == 0) astray_.reset();
  if (!rival_) return;
  const double odds = rival_log_odds_ - believed_.place_log_odds(sighting.fix.utime, options_.lock);
  rival_is_likelier_ = odds > 0.0;
  if (odds < -kNoDoubt) forget_rival();
}

void Fusion::solve_and_watch_for_jump() {
  const Eigen::Vector3d before = graph_->state(graph_->newest().id).p();
  graph_->solve();
  update_newest();
  if ((newest_.state.p() - before).norm() > options_.reset_jump) ++reset_counter_;
}

void Fusion::update_newest() {
  newest_ = graph_->estimate(graph_->newest().id);
  level_ = Protection();
  const int64_t now = graph_->newest().utime;
  const auto exposure = static_cast<int64_t>(1e6 * options_.protection.exposure);
  if (rival_ && now - rival_utime_ >= exposure) forget_rival();
  // Neither their place nor their accuracy may be wrong more often than a level allows for a fault.
  const int64_t newest = confirming_.newest_utime();
  const double least = log_odds_of(1.0 - kFaultProbability);
  if (confirming_.place_log_odds(newest, options_.lock) < least) return;
  if (confirming_.accuracy_log_odds(newest, options_.lock) < least) return;
  const std::optional<Estimate> without = graph_->without_fixes_after(now - exposure);
  if (!without) return;
  const auto located = [](const Estimate& estimate) {
    return Located{estimate.state.p(), estimate.covariance.block<3, 3>(kPosition, kPosition)};
  };
  const Located given = located(newest_);
  std::optional<Located> rival;
  if (rival_) rival = Located{given.p_G_B + rival_->p_G_B, rival_->covariance};
  level_ = protect(given, located(*without), rival);
}

}  // namespace orthonav::fusion
