#include "services/fusion/fusion_service.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <utility>

#include <fmt/format.h>

#include "common/bus/channels.h"
#include "common/math/so3.h"
#include "orthonav/nav_state_t.hpp"

namespace orthonav::fusion {
namespace {

constexpr int64_t kAnswersFor = 1'000'000;  // microseconds after a good odometry state
constexpr std::chrono::milliseconds kWatchPeriod{500};
constexpr int64_t kLongestQuiet = 2'500'000;  // microseconds without anything to publish

using RowMajor3 = Eigen::Matrix<double, 3, 3, Eigen::RowMajor>;
using RowMajor6 = Eigen::Matrix<double, 6, 6, Eigen::RowMajor>;

Eigen::Vector3d vector_of(const double (&v)[3]) {
  return Eigen::Vector3d(v[0], v[1], v[2]);
}
Eigen::Quaterniond quaternion_of(const double (&q)[4]) {
  return Eigen::Quaterniond(q[0], q[1], q[2], q[3]);
}
void put(const Eigen::Vector3d& v, double (&out)[3]) {
  std::copy_n(v.data(), 3, out);
}

void put(const Eigen::Quaterniond& q, double (&out)[4]) {
  out[0] = q.w();
  out[1] = q.x();
  out[2] = q.y();
  out[3] = q.z();
}

nav_state_t message_of(const Solution& solution) {
  nav_state_t nav;
  nav.utime = solution.utime;
  nav.mode = static_cast<int8_t>(solution.mode);
  nav.session = solution.session;
  nav.latitude_deg = solution.position.latitude_deg;
  nav.longitude_deg = solution.position.longitude_deg;
  nav.ellipsoidal_height = solution.position.height;
  nav.anchor_latitude_deg = solution.anchor.latitude_deg;
  nav.anchor_longitude_deg = solution.anchor.longitude_deg;
  nav.anchor_height = solution.anchor.height;
  put(solution.p_G_B, nav.p_G_B);
  put(solution.v_G_B, nav.v_G_B);
  put(solution.q_G_B, nav.q_G_B);
  Eigen::Map<RowMajor6>(nav.covariance) = solution.covariance;
  nav.time_since_fix = solution.time_since_fix;
  nav.num_fixes = solution.num_fixes;
  nav.reset_counter = solution.reset_counter;
  nav.source = solution.inertial ? nav_state_t::INERTIAL : nav_state_t::FRAME;
  Eigen::Map<RowMajor3>(nav.velocity_covariance) = solution.velocity_covariance;
  nav.horizontal_protection_level = solution.horizontal_protection_level;
  nav.vertical_protection_level = solution.vertical_protection_level;
  nav.odometry_scale = solution.scale;
  nav.heading_offset = solution.heading_offset;
  nav.compass_bias = solution.compass_bias;
  nav.vertical_offset = solution.vertical_offset;
  return nav;
}

// Nothing where the fix does not say: NaN, or zeros of a producer that does not know these fields.
std::optional<Upright> upright_of(const map_fix_t& message) {
  Upright upright;
  upright.p_G_B = vector_of(message.upright_p_G_B) - vector_of(message.p_G_B);
  upright.covariance = Eigen::Map<const RowMajor3>(message.upright_covariance);
  upright.lever = Eigen::Map<const Eigen::Matrix<double, 3, 2, Eigen::RowMajor>>(message.upright_lever);
  upright.tilt = Eigen::Map<const Eigen::Vector2d>(message.tilt);
  upright.tilt_covariance = Eigen::Map<const Eigen::Matrix<double, 2, 2, Eigen::RowMajor>>(message.tilt_covariance);
  const bool said = upright.p_G_B.allFinite() && upright.covariance.allFinite() && upright.lever.allFinite() &&
                    upright.tilt.allFinite() && upright.tilt_covariance.trace() > 0.0;
  return said ? std::optional(upright) : std::nullopt;
}

}  // namespace

FusionService::FusionService(Node& node, const std::filesystem::path& config_folder, std::filesystem::path memory_file)
    : node_(node), fusion_(FusionOptions::load(config_folder)), memory_file_(std::move(memory_file)) {
  if (!memory_file_.empty()) {
    const auto memory = read_memory(memory_file_);
    if (memory && fusion_.resume(*memory)) node_.health().add("memory.read");
  }
  node_.health().set_state(Health::State::kStarting, "waiting for the odometry (VIO_STATE)");
  node_.subscribe<vio_state_t>(channel::kVioState, Delivery::kAll, [this](const vio_state_t& m) { on_state(m); });
  node_.subscribe<vio_keyframe_t>(channel::kVioKeyframe, Delivery::kAll,
                                  [this](const vio_keyframe_t& m) { on_keyframe(m); });
  node_.subscribe<map_fix_t>(channel::kMapFix, Delivery::kAll, [this](const map_fix_t& m) { on_fix(m); });
  node_.subscribe<compass_t>(channel::kCompass, Delivery::kAll, [this](const compass_t& m) { on_compass(m); });
  node_.subscribe<imu_t>(channel::kImu, Delivery::kAll, [this](const imu_t& m) { on_imu(m); });
  for (const char* channel : {channel::kVioState, channel::kCompass, channel::kImu}) node_.expect(channel);
  node_.every(kWatchPeriod, [this] { watch(); });
}

void FusionService::on_state(const vio_state_t& message) {
  OdometryState state;
  state.utime = message.utime;
  state.session = message.session;
  state.has_pose = message.status != vio_state_t::INITIALISING;
  state.has_tracks = message.num_tracked > 0;
  state.p_W_B = vector_of(message.p_W_B);
  state.q_W_B = quaternion_of(message.q_W_B);
  state.v_W_B = vector_of(message.v_W_B);
  state.gyro_bias = vector_of(message.gyro_bias);
  state.accel_bias = vector_of(message.accel_bias);
  state.levelled = Eigen::Map<const Eigen::Vector2d>(message.levelled);
  const auto covariance = Eigen::Map<const Eigen::Matrix<double, 6, 6, Eigen::RowMajor>>(message.pose_covariance);
  state.lean_stddev = std::sqrt(0.5 * covariance.diagonal().segment<2>(3).sum());
  const Fusion::Propagated propagated = fusion_.propagate(state);
  node_.health().add("states.received");
  if (propagated.outcome != Outcome::kUsed) {
    node_.health().reject(fmt::format("state.{}", to_string(propagated.outcome)),
                          "odometry states refused: look at the health of vio");
    // Nonsense between good states is not answered; when nothing else comes, its answer says that there is no pose.
    const bool carried_on = newest_imu_utime_ != 0 && newest_imu_utime_ - newest_state_utime_ < kAnswersFor;
    if (!carried_on) publish(propagated.solution);
    return;
  }
  newest_state_utime_ = state.utime;
  height_above_ground_ = message.height_above_ground;
  publish(propagated.solution);
  report_mode(propagated.solution);
}

void FusionService::on_imu(const imu_t& message) {
  ImuSample sample;
  sample.utime = message.utime;
  sample.angular_rate = vector_of(message.angular_rate);
  sample.specific_force = vector_of(message.specific_force);
  const Fusion::Carried carried = fusion_.add_imu(sample);
  node_.health().add("imu.received");
  if (carried.outcome != Outcome::kUsed) {
    node_.health().reject(fmt::format("imu.{}", to_string(carried.outcome)),
                          "IMU samples refused: look at the health of ingest");
  }
  if (carried.outcome == Outcome::kUsed) newest_imu_utime_ = sample.utime;
  if (!carried.solution) return;
  const bool changed = !last_ || last_->mode != carried.solution->mode;
  publish(*carried.solution);
  if (changed) report_mode(*carried.solution);
}

// Who has neither odometry nor inertial sensor, or only that for too long, has no position, and it is said: silence may
// be anything.
void FusionService::watch() {
  // After a stopped process goes on, several looks come before the messages that wait.
  const int64_t now = node_.steady_now();
  const bool stopped = now - std::exchange(looked_at_, now) > 2 * std::chrono::microseconds(kWatchPeriod).count();
  if (!std::exchange(quiet_, true) || stopped) quiet_since_ = now;
  const int64_t quiet = now - quiet_since_;
  if (quiet < kLongestQuiet || !ever_located_) return;
  height_above_ground_ = kUnknown;
  Solution lost;
  lost.utime = last_->utime + quiet;
  lost.mode = Mode::kLost;
  lost.session = last_->session;
  lost.inertial = true;
  lost.reset_counter = last_->reset_counter;
  send(lost);
  node_.health().set_state(Health::State::kFailed, "the position is lost: no odometry, and nothing to carry it on");
}

void FusionService::on_compass(const compass_t& message) {
  const Outcome outcome = fusion_.add_compass({message.utime, message.heading, message.heading_stddev});
  node_.health().add("compass.received");
  if (outcome != Outcome::kUsed) {
    node_.health().reject(fmt::format("compass.{}", to_string(outcome)),
                          "compass readings refused: the heading rests on the map alone");
  }
}

void FusionService::remember() {
  if (memory_file_.empty()) return;
  const auto memory = fusion_.memory();
  if (memory && !write_memory(memory_file_, *memory)) node_.health().add("memory.not_written");
}

void FusionService::publish(const Solution& solution) {
  send(solution);
  last_ = solution;
  ever_located_ = ever_located_ || solution.located();
  quiet_ = false;
}

void FusionService::send(const Solution& solution) {
  nav_state_t nav = message_of(solution);
  nav.height_above_ground = height_above_ground_;
  nav.processing_ms = solve_ms_;
  node_.publish(channel::kNavState, nav);
}

void FusionService::on_keyframe(const vio_keyframe_t& message) {
  if (repeats_.add(message)) return;
  Keyframe keyframe;
  keyframe.utime = message.utime;
  keyframe.session = message.session;
  keyframe.id = message.id;
  keyframe.p_W_B = vector_of(message.p_W_B);
  keyframe.q_W_B = quaternion_of(message.q_W_B);
  keyframe.levelled = Eigen::Map<const Eigen::Vector2d>(message.levelled);
  keyframe.height_above_ground = message.height_above_ground;
  keyframe.relative_covariance = Eigen::Map<const RowMajor6>(message.relative_covariance);
  const Stopwatch watch(node_);
  const Outcome outcome = fusion_.add_keyframe(keyframe);
  solve_ms_ = watch.ms();
  node_.health().add("keyframes.received");
  if (outcome != Outcome::kUsed) {
    node_.health().reject(fmt::format("keyframe.{}", to_string(outcome)),
                          "keyframes refused: look at the health of vio");
    if (outcome != Outcome::kJump) return;
  }
  if (keyframe.session == last_keyframe_session_ && keyframe.id > last_keyframe_id_ + 1) {
    node_.health().add("keyframes.missed", keyframe.id - last_keyframe_id_ - 1);
  }
  remember();
  last_keyframe_session_ = keyframe.session;
  last_keyframe_id_ = keyframe.id;
  node_.health().set("graph.nodes", fusion_.graph_size());
  node_.health().set("compass.not_believed", fusion_.compass_rejected());
}

void FusionService::on_fix(const map_fix_t& message) {
  node_.health().add("fixes.received");
  if (!message.valid) {
    node_.health().add("fixes.invalid");
    return;
  }
  Fix fix;
  fix.utime = message.utime;
  fix.session = message.session;
  fix.keyframe_id = message.keyframe_id;
  fix.position = {message.latitude_deg, message.longitude_deg, message.ellipsoidal_height};
  fix.anchor = {message.anchor_latitude_deg, message.anchor_longitude_deg, message.anchor_height};
  fix.covariance = Eigen::Map<const RowMajor3>(message.position_covariance);
  const Eigen::Quaterniond q_G_B = quaternion_of(message.q_G_B);
  fix.heading = q_G_B.coeffs().allFinite() ? heading_of(q_G_B.normalized()) : message.heading;
  fix.heading_stddev = message.heading_stddev;
  if (message.heading_correction_stddev > 0) {  // NaN: not fitted
    fix.heading_fitted = true;
    fix.heading = message.heading;
    fix.heading_stddev = message.heading_correction_stddev;
  }
  fix.scale = message.scale;
  fix.scale_stddev = message.scale_stddev;
  fix.log_odds = message.log_odds;
  fix.num_keyframes = message.num_keyframes;
  fix.upright = upright_of(message);

  const Stopwatch watch(node_);
  const Outcome outcome = fusion_.add_fix(fix);
  switch (outcome) {
    case Outcome::kLocked:
    case Outcome::kRelocked:
      node_.health().add(fmt::format("fixes.{}", to_string(outcome)));
      [[fallthrough]];
    case Outcome::kUsed:
      solve_ms_ = watch.ms();
      node_.health().add("fixes.used");
      node_.health().set("solve.ms", solve_ms_);
      node_.health().set("graph.nodes", fusion_.graph_size());
      node_.health().set("odometry.scale", fusion_.scale());
      remember();
      break;
    case Outcome::kWaiting:
    case Outcome::kOutlier:
      // Part of the work: a service is not degraded because it does not believe everything.
      node_.health().add(fmt::format("fixes.{}", to_string(outcome)));
      break;
    default:
      node_.health().reject(fmt::format("fix.{}", to_string(outcome)),
                            "fixes refused: look at the health of registration");
  }
}

void FusionService::report_mode(const Solution& solution) {
  using State = Health::State;
  switch (solution.mode) {
    case Mode::kWaitingForVio:
      node_.health().set_state(State::kStarting, "waiting for the odometry to initialise");
      break;
    case Mode::kDeadReckoning:
      node_.health().set_state(State::kStarting, "no position yet: waiting for fixes that agree");
      break;
    case Mode::kMapAided:
    case Mode::kReacquired:
      node_.health().set_state(State::kOk);
      break;
    case Mode::kCoasting:
      node_.health().set_state(State::kDegraded,
                               fusion_.unconfirmed()
                                   ? "carried across a restart: waiting for a fix that agrees"
                                   : fmt::format("no fix for {:.0f} s: the position drifts", solution.time_since_fix));
      break;
    case Mode::kLost:
      node_.health().set_state(State::kFailed, "the position is lost: waiting for fixes that agree");
      break;
  }
}

}  // namespace orthonav::fusion
