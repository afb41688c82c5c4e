#include "services/fusion/inertial.h"

#include <algorithm>
#include <cmath>

#include "common/math/so3.h"
#include "common/math/stamps.h"

namespace orthonav::fusion {
namespace {

constexpr size_t kMaxSamples = 10'000;  // bounds the memory when no odometry state comes
constexpr int64_t kNear = 100'000;      // microseconds
constexpr double kFastest = 100.0;      // rad/s: no airframe turns like this
constexpr double kHardest = 1000.0;     // m/s^2

double seconds_between(int64_t from, int64_t to) {
  return 1e-6 * static_cast<double>(to - from);
}

}  // namespace

void Inertial::rebase(const InertialState& state, const Eigen::Vector3d& gyro_bias, const Eigen::Vector3d& accel_bias) {
  base_ = state;
  state_ = state;
  gap_ = guessed_ = false;
  gyro_bias_ = gyro_bias;
  accel_bias_ = accel_bias;
  while (samples_.size() > 1 && samples_[1].utime <= state.utime) samples_.pop_front();
  if (samples_.empty() || samples_.back().utime <= state.utime) return;
  // The first step begins at the base: by the sample before it, if there is one, at the base's time.
  ImuSample before = samples_.front();
  before.utime = state.utime;
  for (const ImuSample& sample : samples_) {
    if (sample.utime <= state.utime) continue;
    integrate(before, sample);
    before = sample;
  }
}

Outcome Inertial::add(const ImuSample& sample) {
  if (!sample.angular_rate.allFinite() || !sample.specific_force.allFinite() || sample.angular_rate.norm() > kFastest ||
      sample.specific_force.norm() > kHardest) {
    return Outcome::kBadNumber;
  }
  if (!samples_.empty() && of_another_time(sample.utime, samples_.back().utime)) {
    samples_.clear();
    base_.reset();
  }
  if (!samples_.empty() && sample.utime <= samples_.back().utime) return Outcome::kOutOfOrder;
  if (base_ && sample.utime > base_->utime) {
    ImuSample before = samples_.empty() ? sample : samples_.back();
    before.utime = std::max(state_.utime, before.utime);
    integrate(before, sample);
  }
  samples_.push_back(sample);
  if (samples_.size() > kMaxSamples) samples_.pop_front();
  return Outcome::kUsed;
}

void Inertial::integrate(const ImuSample& from, const ImuSample& to) {
  const double dt = seconds_between(from.utime, to.utime);
  guessed_ = guessed_ || dt > options_.max_gap;
  gap_ = gap_ || dt > std::max(options_.max_gap, options_.bridged_gap);
  step(from, to, state_);
}

void Inertial::step(const ImuSample& from, const ImuSample& to, InertialState& state) const {
  const double dt = seconds_between(from.utime, to.utime);
  const Eigen::Vector3d rate = 0.5 * (from.angular_rate + to.angular_rate) - gyro_bias_;
  const Eigen::Vector3d force = 0.5 * (from.specific_force + to.specific_force) - accel_bias_;
  const Eigen::Quaterniond middle = state.q_G_B * so3_exp(0.5 * dt * rate);
  const Eigen::Vector3d force_G = middle * force;
  const Eigen::Vector3d acceleration = force_G - options_.gravity * Eigen::Vector3d::UnitZ();
  state.p_G_B += dt * state.v_G_B + 0.5 * dt * dt * acceleration;
  state.v_G_B += dt * acceleration;
  state.q_G_B = (state.q_G_B * so3_exp(dt * rate)).normalized();
  state.utime = to.utime;

  Matrix9d F = Matrix9d::Identity();
  F.block<3, 3>(0, 3) = dt * Eigen::Matrix3d::Identity();
  F.block<3, 3>(3, 6) = -dt * skew(force_G);
  state.covariance = F * state.covariance * F.transpose();
  state.covariance.diagonal().segment<3>(3).array() += options_.accel_noise * options_.accel_noise * dt;
  state.covariance.diagonal().tail<3>().array() += options_.gyro_noise * options_.gyro_noise * dt;
  if (dt > options_.max_gap) state.covariance += of_a_guess(dt);
}

// What the motion between two samples may have been other than half of each.
Matrix9d Inertial::of_a_guess(double dt) const {
  const double a = options_.gap_accel_stddev;
  const double tilt = options_.gap_tilt_stddev, turn = options_.gap_turn_stddev * dt;
  Matrix9d covariance = Matrix9d::Zero();
  for (int axis = 0; axis < 3; ++axis) {
    const Eigen::Vector2d part(0.5 * a * dt * dt, a * dt);
    for (int i = 0; i < 2; ++i) {
      for (int j = 0; j < 2; ++j) covariance(3 * i + axis, 3 * j + axis) = part(i) * part(j);
    }
  }
  covariance.diagonal().tail<3>() << tilt * tilt, tilt * tilt, turn * turn;
  return covariance;
}

std::optional<InertialState> Inertial::newest() const {
  if (!base_ || gap_ || state_.utime <= base_->utime) return std::nullopt;
  const double t = seconds_between(base_->utime, state_.utime);
  if (t > options_.max_time) return std::nullopt;
  return with_biases(state_);
}

InertialState Inertial::with_biases(InertialState state) const {
  const double t = seconds_between(base_->utime, state.utime);
  // A constant bias about the axes of G: its part in position, velocity and attitude after t seconds. A turned "up"
  // leaks gravity into the acceleration.
  const double a = options_.accel_bias_stddev;
  const double w = options_.gyro_bias_stddev;
  const double leak = options_.gravity * w;
  Matrix9d bias = Matrix9d::Zero();
  for (int axis = 0; axis < 3; ++axis) {
    const double leaks = axis < 2 ? leak : 0.0;
    const Eigen::Vector3d by_accel(0.5 * a * t * t, a * t, 0.0);
    const Eigen::Vector3d by_gyro(leaks * t * t * t / 6.0, 0.5 * leaks * t * t, 0.0);
    const Eigen::Matrix3d part = by_accel * by_accel.transpose() + by_gyro * by_gyro.transpose();
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) bias(3 * i + axis, 3 * j + axis) = part(i, j);
    }
    bias(6 + axis, 6 + axis) += w * w * t * t;
  }
  state.covariance += bias;
  return state;
}

std::optional<InertialState> Inertial::at(int64_t utime) const {
  std::optional<InertialState> state = newest();
  if (!state || utime - state->utime > kNear) return std::nullopt;
  if (utime < state->utime) {
    if (utime <= base_->utime) return std::nullopt;
    InertialState then = *base_;
    ImuSample before = samples_.front();
    before.utime = base_->utime;
    for (const ImuSample& sample : samples_) {
      if (sample.utime <= base_->utime) continue;
      if (sample.utime > utime) break;
      step(before, sample, then);
      before = sample;
    }
    state = with_biases(then);
  }
  state->p_G_B += seconds_between(state->utime, utime) * state->v_G_B;
  state->utime = utime;
  return state;
}

}  // namespace orthonav::fusion
