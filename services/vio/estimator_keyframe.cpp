// What the estimator tells others: the newest state and keyframes, each continuing what was told before.
#include <cmath>
#include <limits>

#include "common/math/so3.h"
#include "services/vio/estimator.h"
#include "services/vio/projection_factor.h"

namespace orthonav::vio {
namespace {

constexpr double kNoiseShare = 0.05;  // that one motion has in the noise measured

// The shortest turn (a rotation vector, applied at the left) after which `q` leaves the vertical where it is.
Eigen::Vector3d turn_upright(const Eigen::Quaterniond& q) {
  return so3_log(Eigen::Quaterniond::FromTwoVectors(q * Eigen::Vector3d::UnitZ(), Eigen::Vector3d::UnitZ()));
}

}  // namespace

void Estimator::follow_published() {
  const Frame& newest = *frames_.back();
  const Frame& last = *frames_[frames_.size() - 2];
  if (last.keyframe_id >= 0) {
    const Eigen::Quaterniond q = last.published.q() * last.state.q().conjugate();
    // A part of it at a time.
    const Eigen::Vector3d tilt = turn_upright(q);
    const double part =
        1.0 - std::exp(-1e-6 * static_cast<double>(newest.utime - last.utime) / options_.tilt_return_time);
    levelled_ = last.levelled + part * tilt.head<2>();
    q_P_W_ = (so3_exp(part * tilt) * q).normalized();
    p_P_W_ = last.published.p() - q_P_W_ * last.state.p();
  }
  newest_ = as_published(newest.state);
}

StateValues Estimator::as_published(const StateValues& state) const {
  StateValues result = state;
  result.p() = q_P_W_ * state.p() + p_P_W_;
  result.v() = q_P_W_ * state.v();
  result.q() = q_P_W_ * state.q();
  // Whoever integrates the IMU from this attitude wants the bias that goes with it.
  const Eigen::Vector3d up = Eigen::Vector3d::UnitZ();
  result.ba() += options_.gravity * (state.q().conjugate() * up - result.q().conjugate() * up);
  return result;
}

void Estimator::publish_keyframe() {
  Frame& newest = *frames_.back();
  newest.keyframe_id = next_keyframe_id_++;
  Keyframe keyframe;
  keyframe.utime = newest.utime;
  keyframe.id = newest.keyframe_id;
  newest.published = keyframe.state = newest_;
  newest.levelled = keyframe.levelled = levelled_;
  keyframe.height_above_ground = height_;
  keyframe.relative_covariance.setConstant(std::numeric_limits<double>::quiet_NaN());
  keyframe.scale_stddev = std::numeric_limits<double>::quiet_NaN();
  for (const auto& [id, landmark] : landmarks_) {
    if (!landmark.tracked || !landmark.has_depth || landmark.observations.size() < 2) continue;
    const Observation& anchor = landmark.anchor();
    const Observation& here = landmark.observations.back();
    const StateValues& at = anchor.frame->state;
    KeyframeFeature feature;
    feature.id = id;
    feature.pixel = here.pixel;
    feature.ray_C = here.ray;
    const Eigen::Vector3d p_W = position_of(landmark);
    feature.p_W = q_P_W_ * p_W + p_P_W_;
    feature.reprojection_error = landmark.reprojection_error;
    double information = 0;
    for (size_t k = 1; k < landmark.observations.size(); ++k) {
      const Observation& other = landmark.observations[k];
      ProjectionFactor::Jacobians J;
      if (ProjectionFactor::evaluate(bearings_of(anchor, other), time_offset(), extrinsics_, weight(), at.pose.data(),
                                     other.frame->state.pose.data(), landmark.inverse_depth, nullptr, &J)) {
        information += J.inverse_depth.squaredNorm();
      }
    }
    feature.depth_stddev = 1.0 / (std::sqrt(information) * landmark.inverse_depth * landmark.inverse_depth);
    keyframe.features.push_back(feature);
  }

  const NormalEquations equations = normal_equations();
  // What contradicts what was known says that it was not known so well: for as long as the window remembers.
  widening_ = std::max(1.0, widening_ + (prior_.departure() - widening_) / options_.window);
  update_covariance(equations, keyframe);
  // Of the oldest motion everything is known that ever will be. What contradicts the camera is no noise.
  if (static_cast<int>(frames_.size()) > options_.window && error_time_ == 0)
    imu_noise_.learn(imu_noise_of(equations, 1), kNoiseShare);
  if (height_ > 0 && std::isfinite(scale_stddev_)) {
    memory_ = Memory{newest.utime, height_, height_ * scale_stddev_, newest_.v().z(), newest_.bg(), time_offset()};
  }
  published_ = std::move(keyframe);
}

void Estimator::publish_anew() {
  rescaled_ = true;
  q_P_W_.setIdentity();
  p_P_W_.setZero();
  levelled_.setZero();
  next_keyframe_id_ = 0;
  for (const auto& frame : frames_) {
    frame->keyframe_id = -1;
    if (frame->at_start) frame->at_start = frame->state.p();
  }
  newest_ = as_published(frames_.back()->state);
}

void Estimator::update_covariance(const NormalEquations& equations, Keyframe& keyframe) {
  const Frame& newest = *frames_.back();
  const Frame& previous = *frames_[frames_.size() - 2];
  std::vector<int> rows;
  for (const int offset : {equations.pose_offset(previous), equations.pose_offset(newest)}) {
    for (int k = 0; k < 6; ++k) rows.push_back(offset + k);
  }
  for (int k = 0; k < 9; ++k) rows.push_back(equations.speed_bias_offset(newest) + k);
  const Eigen::MatrixXd joint = widening_ * equations.covariance(rows);
  scale_stddev_ = std::sqrt(widening_) * scale_sigma(equations);
  keyframe.scale_stddev = scale_stddev_;
  if (joint.size() == 0) return;
  const Eigen::Matrix3d R_prev = previous.state.q().toRotationMatrix();
  const Eigen::Matrix3d R_new = newest.state.q().toRotationMatrix();
  const Eigen::Matrix3d R_P_W = q_P_W_.toRotationMatrix();
  // To a rotation vector in W: R_hat Exp(e) = Exp(R_hat e) R_hat.
  Eigen::Matrix<double, 6, 6> to_world = Eigen::Matrix<double, 6, 6>::Identity();
  to_world.topLeftCorner<3, 3>() = R_P_W;
  to_world.bottomRightCorner<3, 3>() = R_P_W * R_new;
  pose_covariance_ = to_world * joint.block<6, 6>(6, 6) * to_world.transpose();
  velocity_covariance_ = R_P_W * joint.block<3, 3>(12, 12) * R_P_W.transpose();
  // What is told has yet to follow the window's vertical by so much.
  const Eigen::Vector3d behind = turn_upright(q_P_W_);
  pose_covariance_.bottomRightCorner<3, 3>() += behind * behind.transpose();
  const Eigen::Vector3d astray = behind.cross(newest_.v());
  velocity_covariance_ += astray * astray.transpose();
  bias_covariance_ = joint.bottomRightCorner<6, 6>();
  const Eigen::Vector3d of_gravity =
      options_.gravity * (newest_.q().conjugate() * behind.cross(Eigen::Vector3d::UnitZ()));
  bias_covariance_.topLeftCorner<3, 3>() += of_gravity * of_gravity.transpose();
  if (previous.keyframe_id == keyframe.id - 1 && previous.keyframe_id >= 0) {
    Eigen::Matrix<double, 6, 12> J = Eigen::Matrix<double, 6, 12>::Zero();
    J.block<3, 3>(0, 0) = -R_prev.transpose();
    J.block<3, 3>(0, 3) = skew(R_prev.transpose() * (newest.state.p() - previous.state.p()));
    J.block<3, 3>(0, 6) = R_prev.transpose();
    J.block<3, 3>(3, 3) = -R_new.transpose() * R_prev;
    J.block<3, 3>(3, 9).setIdentity();
    keyframe.relative_covariance = J * joint.topLeftCorner<12, 12>() * J.transpose();
    const Eigen::Vector2d step = levelled_ - previous.levelled;
    const Eigen::Vector3d step_B = newest_.q().conjugate() * Eigen::Vector3d(step.x(), step.y(), 0);
    keyframe.relative_covariance.bottomRightCorner<3, 3>() += step_B * step_B.transpose();
  }
}

}  // namespace orthonav::vio
