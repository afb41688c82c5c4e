// The part of Fusion that answers: at odometry states, at inertial samples, and while the odometry restarts.
#include <algorithm>
#include <cmath>
#include <utility>

#include "common/math/so3.h"
#include "services/fusion/error_budget.h"
#include "services/fusion/fusion.h"
#include "services/fusion/plausible.h"

namespace orthonav::fusion {
namespace {

// Without an odometry state for so long the position rests on the inertial sensor alone, s.
constexpr double kBlindAfter = 1.0;
// How far a place is to be trusted that the odometry has not carried along without a break: what ended a session may
// have led it astray before.
constexpr double kCarriedTrust = 0.9;
// Standard deviation, m, of a position carried across a restart, beyond which one fix does not confirm it.
constexpr double kWide = 5.0;

using Rows6 = Eigen::Matrix<double, 6, kStates>;

}  // namespace

Fusion::Propagated Fusion::propagate(const OdometryState& state) {
  Propagated result;
  const auto refuse = [&](Outcome outcome) {
    result.outcome = outcome;
    result.solution.utime = state.utime;
    result.solution.session = session_;
    result.solution.reset_counter = reset_counter_;
    return result;
  };
  if (state.has_pose && is_pose(state.p_W_B, state.q_W_B)) {
    go_on(state.session, state.utime, state.p_W_B);
  } else if (!state.has_pose && memory_ && state.session != memory_->keyframe.session) {
    go_on(state.session, state.utime, Eigen::Vector3d::Constant(kUnknown));
  }
  if (state.session < session_) return refuse(Outcome::kOldSession);
  if (state.session > session_) {
    if (session_ > 0 && state.session - session_ > kLargestSessionGap) return refuse(Outcome::kBadNumber);
    start_segment(state.session);
  }
  // A session that has begun does not initialise again: the odometry begins another one.
  if (!state.has_pose && last_state_) return refuse(Outcome::kOutOfOrder);
  if (state.has_pose) {
    if (!is_pose(state.p_W_B, state.q_W_B) || !is_levelled(state.levelled)) return refuse(Outcome::kBadNumber);
    const std::optional<OdometryState> last = last_state_;
    if (last && state.utime <= last->utime) return refuse(Outcome::kOutOfOrder);
    last_state_ = state;
    if (last) {
      const double duration = std::max(1e-3, seconds_between(last->utime, state.utime));
      if ((state.p_W_B - last->p_W_B).norm() > options_.max_speed * duration) return refuse(Outcome::kJump);
    }
    if (!graph_) start_bridge(state);
    if (graph_ && !state.has_tracks) doubt_way(state.utime);
    has_output_ = true;
  }
  Solution& solution = result.solution;
  solution.utime = state.utime;
  solution.session = session_;
  if (state.has_pose && graph_) {
    solution = located(state, solution);
    judge(solution, true, false);
    last_located_ = solution;
    return result;
  }
  // A state of before the inertial sensor lost its way, or one that it can still carry.
  if (const auto inertial = frame_ ? inertial_.at(state.utime) : std::nullopt; inertial && last_located_) {
    solution = carried(*inertial);
    solution.inertial = false;
    // Late states do not bring back what the inertial sensor's samples have said since.
    const int64_t now = std::max(state.utime, inertial_.newest()->utime);
    judge(solution, state.has_pose, seconds_between(odometry_utime_, now) > kBlindAfter);
    return result;
  }
  if (frame_ && !graph_ && last_located_) {
    // Older than what the inertial sensor goes on from, or ahead of its samples: no reason to give the position up.
    if (inertial_.newest()) return refuse(Outcome::kOutOfOrder);
    leave_map();
  }
  if (state.has_pose) {
    solution.p_G_B = state.p_W_B;
    solution.v_G_B = state.v_W_B;
    solution.q_G_B = state.q_W_B.normalized();
  }
  judge(solution, state.has_pose, false);
  return result;
}

// Images may be missing for a moment; or they, and the inertial samples with them, are another aircraft's.
void Fusion::doubt_way(int64_t utime) {
  believed_ = Agreement(1, log_odds_of(kCarriedTrust), 0.0, utime);
  confirming_ = {};
  level_ = {};
  to_confirm_ = std::max(to_confirm_, 1);
  if (astray_) astray_->turn_in_graph = false;
  if (astray_) return;
  const bool has_speed = last_located_ && last_located_->v_G_B.allFinite();
  astray_ = Astray{utime, has_speed ? last_located_->v_G_B.norm() : 0.0, 0.0, false};
}

// By the way that the aircraft may have flown, and by the one that is said.
double Fusion::astray_variance(int64_t utime, const Eigen::Vector3d& v) const {
  if (!astray_) return 0.0;
  const double said = v.allFinite() ? v.norm() : 0.0;
  const double off = (astray_->speed + said) * std::max(0.0, seconds_between(astray_->utime, utime));
  return off * off;
}

// Fills in what depends on more than the pose.
void Fusion::judge(Solution& solution, bool odometry, bool blind) {
  const bool is_located = solution.located();
  if (is_located && astray_) {
    const double more = astray_variance(solution.utime, solution.v_G_B) - astray_->in_graph;
    solution.covariance.diagonal().head<3>().array() += std::max(0.0, more);
    solution.horizontal_protection_level = solution.vertical_protection_level = kUnknown;
  }
  if (is_located) {
    solution.num_fixes = num_fixes_;
    solution.time_since_fix = seconds_between(newest_fix_utime_, solution.utime);
  }
  solution.reset_counter = reset_counter_;
  Evidence evidence;
  evidence.utime = solution.utime;
  evidence.odometry = odometry;
  evidence.located = is_located;
  evidence.blind = blind;
  evidence.unconfirmed = to_confirm_ > 0;
  evidence.contradicted = rival_is_likelier_ && rival_utime_ > newest_fix_utime_;
  evidence.level = solution.horizontal_protection_level;
  // How far another place is does not say how likely it is.
  if (is_located && (std::isnan(evidence.level) || rival_)) {
    evidence.level = kHorizontalQuantile * horizontal_stddev(solution.covariance.topLeftCorner<3, 3>());
  }
  evidence.time_since_fix = solution.time_since_fix;
  evidence.moves = moves_;
  solution.mode = modes_.update(evidence);
}

Solution Fusion::located(const OdometryState& state, Solution solution) {
  const Keyframe& keyframe = graph_->newest();
  const Eigen::Quaterniond q_W_B = state.q_W_B.normalized();
  // From the newest keyframe to this state, as an edge of its own.
  Keyframe here;
  here.utime = std::max(state.utime, keyframe.utime + 1);
  here.p_W_B = state.p_W_B;
  here.q_W_B = q_W_B;
  here.height_above_ground = keyframe.height_above_ground;
  here.levelled = state.levelled;
  here.lean_stddev = state.lean_stddev;
  const Transition transition = transition_between(options_, keyframe, here, newest_.state.q_G_W());
  NodeState node = newest_.state;
  node.x.segment<2>(kLean) += transition.lean_change;
  const double scale = std::exp(node.log_scale());
  const Eigen::Quaterniond q_G_W = node.q_G_W();
  const Eigen::Vector3d moved = scale * (q_G_W * (state.p_W_B - keyframe.p_W_B));
  solution.p_G_B = node.p() + moved;
  solution.v_G_B = scale * (q_G_W * state.v_W_B);
  solution.q_G_B = (q_G_W * q_W_B).normalized();

  const Eigen::Matrix3d J_rotation = rotation_jacobian(node);
  Eigen::Matrix<double, 9, kStates> J = Eigen::Matrix<double, 9, kStates>::Zero();  // position, velocity, rotation
  J.block<3, 3>(0, kPosition).setIdentity();
  J.block<3, 3>(0, kYaw) = -skew(moved) * J_rotation;
  J.col(kScale).head<3>() = moved;
  if (solution.v_G_B.allFinite()) {
    J.block<3, 3>(3, kYaw) = -skew(solution.v_G_B) * J_rotation;
    J.col(kScale).segment<3>(3) = solution.v_G_B;
  }
  J.block<3, 3>(6, kYaw) = J_rotation;
  InertialState inertial;
  inertial.utime = state.utime;
  inertial.p_G_B = solution.p_G_B;
  inertial.v_G_B = solution.v_G_B;
  inertial.q_G_B = solution.q_G_B;
  inertial.covariance = J * newest_.covariance * J.transpose();
  const Eigen::Matrix3d root = transition.position_root.inverse();
  inertial.covariance.topLeftCorner<3, 3>() += root * root.transpose();
  const double velocity_stddev = options_.edge.velocity_stddev * working_height(options_.edge, keyframe);
  inertial.covariance.diagonal().segment<3>(3).array() += velocity_stddev * velocity_stddev;
  inertial.covariance.diagonal().tail<3>() +=
      Eigen::Vector3d(transition.stddev(kLean), transition.stddev(kLean + 1), transition.stddev(kYaw)).cwiseAbs2();

  solution.covariance << inertial.covariance.topLeftCorner<3, 3>(), inertial.covariance.topRightCorner<3, 3>(),
      inertial.covariance.bottomLeftCorner<3, 3>(), inertial.covariance.bottomRightCorner<3, 3>();
  if (solution.v_G_B.allFinite()) solution.velocity_covariance = inertial.covariance.block<3, 3>(3, 3);
  const Protection level = carried_on(level_, newest_.covariance.block<3, 3>(kPosition, kPosition),
                                      inertial.covariance.topLeftCorner<3, 3>());
  solution.horizontal_protection_level = level.horizontal;
  solution.vertical_protection_level = level.vertical;
  solution.scale = scale;
  solution.heading_offset = wrap_angle(node.yaw());
  solution.compass_bias = wrap_angle(node.compass_bias());
  solution.vertical_offset = node.shared().z();
  solution.anchor = frame_->anchor();
  solution.position = frame_->to_geodetic(solution.p_G_B);

  odometry_utime_ = state.utime;
  if (solution.v_G_B.allFinite() && state.gyro_bias.allFinite() && is_accel_bias(state.accel_bias)) {
    // An odometry that leans has taken so much of gravity for the accelerometer's bias: whoever is put upright gives it
    // back, or would fall sideways by gravity times the lean.
    const Eigen::Vector3d up = Eigen::Vector3d::UnitZ();
    const Eigen::Vector3d of_gravity = q_W_B.conjugate() * up - solution.q_G_B.conjugate() * up;
    inertial_.rebase(inertial, state.gyro_bias, state.accel_bias + options_.inertial.gravity * of_gravity);
  } else {
    inertial_.invalidate();
  }
  return solution;
}

Fusion::Carried Fusion::add_imu(const ImuSample& sample) {
  Carried result;
  result.outcome = inertial_.add(sample);
  if (result.outcome != Outcome::kUsed || !frame_ || !last_located_) return result;
  const auto state = inertial_.newest();
  if (!state) return result;
  result.solution = carried(*state);
  judge(*result.solution, true, seconds_between(odometry_utime_, sample.utime) > kBlindAfter);
  return result;
}

Solution Fusion::carried(const InertialState& state) {
  Solution solution = *last_located_;
  solution.utime = state.utime;
  solution.session = session_;
  solution.inertial = true;
  solution.p_G_B = state.p_G_B;
  solution.v_G_B = state.v_G_B;
  solution.q_G_B = state.q_G_B;
  solution.position = frame_->to_geodetic(state.p_G_B);
  const Eigen::Matrix3d then = solution.covariance.topLeftCorner<3, 3>();
  solution.covariance << state.covariance.topLeftCorner<3, 3>(), state.covariance.topRightCorner<3, 3>(),
      state.covariance.bottomLeftCorner<3, 3>(), state.covariance.bottomRightCorner<3, 3>();
  solution.velocity_covariance = state.covariance.block<3, 3>(3, 3);
  Protection level;
  // An odometry that has gone may have been wrong before it went, and a guess bounds nothing: no level.
  if (graph_ && !inertial_.guessed() && seconds_between(odometry_utime_, state.utime) <= kBlindAfter) {
    level = carried_on({solution.horizontal_protection_level, solution.vertical_protection_level}, then,
                       state.covariance.topLeftCorner<3, 3>());
  }
  solution.horizontal_protection_level = level.horizontal;
  solution.vertical_protection_level = level.vertical;
  return solution;
}

void Fusion::start_bridge(const OdometryState& state) {
  if (bridge_ || !before_ || !frame_) return;
  const auto inertial = inertial_.at(state.utime);
  if (!inertial) return;
  Estimate bridge = *before_;
  bridge.state.x.segment<3>(kPosition) = inertial->p_G_B;
  // Both attitudes know the vertical: what turns one into the other is a yaw.
  bridge.state.x(kYaw) = yaw_of(inertial->q_G_B * state.q_W_B.conjugate());
  bridge.state.x.segment<2>(kLean).setZero();
  bridge.state.x(kScale) = 0.0;
  bridge.covariance.diagonal().segment<3>(kPosition) = inertial->covariance.diagonal().head<3>();
  bridge.covariance(kYaw, kYaw) = inertial->covariance(8, 8);
  bridge_ = bridge;
  bridge_p_W_B_ = state.p_W_B;
  try_bridge();
}

void Fusion::try_bridge() {
  if (!bridge_ || waypoints_.empty() || graph_) return;
  const Keyframe& first = waypoints_.begin()->second.keyframe;
  NodeState guess = bridge_->state;
  const Eigen::Vector3d back = guess.q_G_W() * (first.p_W_B - bridge_p_W_B_);
  guess.x.segment<3>(kPosition) += back;
  StateVector stddev = bridge_->covariance.diagonal().cwiseSqrt();
  stddev.segment<3>(kPosition).array() += scale_stddev_at(first) * back.norm();
  if (astray_) stddev(kYaw) = kAnyHeading;
  stddev.segment<2>(kLean).setConstant(stddev_of_lean(options_.edge, first));
  stddev(kScale) = scale_stddev_at(first);
  stddev.tail<3>() = shared_stddev(options_.fix);
  guess.x.tail<3>().setZero();
  // The wider, the more places lie within the gate of the first fix.
  to_confirm_ = stddev.segment<2>(kPosition).maxCoeff() > kWide ? 2 : 1;
  graph_ = std::make_unique<PoseGraph>(options_);
  graph_->start(first, guess, stddev);
  for (auto next = std::next(waypoints_.begin()); next != waypoints_.end(); ++next) append(next->second);
  graph_->solve();
  believed_ = Agreement(1, log_odds_of(kCarriedTrust), 0.0, first.utime);
  update_newest();
  for (Sighting& sighting : waiting_) sighting.place_in(*frame_);
  bridge_.reset();
}

}  // namespace orthonav::fusion
