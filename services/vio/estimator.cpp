#include "services/vio/estimator.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "common/math/so3.h"
#include "common/math/stamps.h"
#include "common/math/statistics.h"

namespace orthonav::vio {
namespace {

constexpr double kTolerance = 1e-4;  // relative decrease of the cost at which a frame's solution is good enough
constexpr double kUnknownNoise = 3;  // times pixel_sigma, of tracks that nothing is known of yet
constexpr double kMinDepth = 0.1;    // m, of a point that is seen
constexpr double kNoiseShare = 0.1;  // that a keyframe has in the noise measured

}  // namespace

Estimator::Estimator(const EstimatorOptions& options, const Extrinsics& extrinsics, const ImuNoise& noise, double focal)
    : options_(options), extrinsics_(extrinsics), noise_(noise), focal_(focal) {
  gyro_bias_sigma_ = options.gyro_bias_sigma;
  shared_.state.set(extrinsics);
  shared_.state.time_offset[0] = options.time_offset;
  shared_.camera_free = options.refine_extrinsics;
  shared_.time_free = options.estimate_time_offset;
  reset();
}

void Estimator::reset() {
  if (status_ == Status::kFailed) memory_.reset();
  status_ = Status::kInitialising;
  frames_.clear();
  landmarks_.clear();
  prior_ = {};
  hints_.clear();
  new_hint_.reset();
  shared_.height_free = false;
  shared_.state.height_bias[0] = 0;
  rates_.clear();
  glances_.clear();
  still_ = false;
  still_time_ = 0;
  pixel_sigma_ = std::min(kUnknownNoise * options_.pixel_sigma, options_.max_pixel_sigma);
  widening_ = 1;
  error_time_ = 0;
  sunk_time_ = 0;
  tried_utime_ = 0;
  start_due_ = false;
  seen_utime_ = 0;
  last_frame_utime_ = 0;
  next_frame_id_ = 0;
  next_keyframe_id_ = 0;
  height_ = std::numeric_limits<double>::quiet_NaN();
  pose_covariance_.setConstant(std::numeric_limits<double>::quiet_NaN());
  velocity_covariance_.setConstant(std::numeric_limits<double>::quiet_NaN());
  bias_covariance_.setConstant(std::numeric_limits<double>::quiet_NaN());
  scale_stddev_ = std::numeric_limits<double>::quiet_NaN();
  q_P_W_.setIdentity();
  p_P_W_.setZero();
  levelled_.setZero();
  newest_ = StateValues{};
  published_.reset();
  outliers_.clear();
  rescaled_ = false;
}

bool Estimator::resume(const Memory& memory) {
  constexpr double kHighest = 1e5, kFastest = 100;  // m, m/s
  if (!is_stamp(memory.utime)) return false;
  if (!(memory.height > 0 && memory.height < kHighest && memory.height_stddev >= 0 && memory.height_stddev < kHighest &&
        std::abs(memory.climb) < kFastest && memory.gyro_bias.norm() < options_.max_gyro_bias &&
        std::abs(memory.time_offset - options_.time_offset) <= options_.max_time_offset)) {
    return false;
  }
  memory_ = memory;
  gyro_bias_ = memory.gyro_bias;
  gyro_bias_known_ = true;
  if (options_.estimate_time_offset) shared_.state.time_offset[0] = memory.time_offset;
  return true;
}

void Estimator::hint_scale(double ratio, double stddev) {
  if (status_ == Status::kInitialising || !(ratio > 0.5 && ratio < 2.0) || !(stddev > 1e-4 && stddev < 1.0)) return;
  new_hint_ = {ratio, stddev};
}

Estimator::Status Estimator::process(int64_t utime, const std::vector<TrackedFeature>& features,
                                     const std::vector<ImuSample>& imu,
                                     const std::optional<HeightMeasurement>& height) {
  published_.reset();
  outliers_.clear();
  rescaled_ = false;
  start_due_ = false;
  if (frames_.size() > 1 && !frames_.back()->keyframe) {
    std::unique_ptr<Preintegration> kept = std::move(frames_.back()->imu);
    const StateValues propagated_from = frames_.back()->state;
    drop_newest();
    add_frame(utime, imu);
    // The new frame follows the last keyframe now; its state was propagated from the dropped one.
    Frame& newest = *frames_.back();
    kept->append(*newest.imu);
    const Preintegration& step = *newest.imu;
    const Eigen::Vector3d g(0, 0, -options_.gravity);
    const double T = step.duration();
    newest.state = propagated_from;
    newest.state.p() = propagated_from.p() + propagated_from.v() * T + 0.5 * T * T * g +
                       propagated_from.q() * step.corrected_alpha(propagated_from.ba(), propagated_from.bg());
    newest.state.v() = propagated_from.v() + T * g +
                       propagated_from.q() * step.corrected_beta(propagated_from.ba(), propagated_from.bg());
    newest.state.q() = (propagated_from.q() * step.corrected_gamma(propagated_from.bg())).normalized();
    newest.imu = std::move(kept);
  } else {
    add_frame(utime, imu);
  }
  imu_noise_.see(imu, noise_);
  add_observations(features, imu);
  watch_standstill(utime, features, imu);
  Frame& newest = *frames_.back();
  if (height && options_.use_altitude) {
    newest.height = height;
    newest.height->stddev = std::hypot(height->stddev, options_.altitude_relief);
  }
  if (status_ == Status::kInitialising) {
    collect_for_start();
    return status_;
  }
  // Standstill over a second, seen to half a pixel: so fast it may still drift.
  if (still_) newest.still_sigma = 0.01 + (height_ > 0 ? 0.5 * height_ / focal_ : 0);
  choose_keyframe();
  if (next_keyframe_id_ == 0) newest.keyframe = true;
  triangulate();
  choose_height_landmark(newest);
  if (newest.keyframe) take_hint();
  optimise(options_.iterations, kTolerance);
  prior_.follow();
  find_outliers();
  if (newest.keyframe) measure_noise(kNoiseShare);
  gyro_bias_ = newest.state.bg();
  update_height();
  const std::string failure = find_failure();
  if (!failure.empty()) {
    status_ = Status::kFailed;
    reason_ = failure;
    return status_;
  }
  follow_published();
  if (newest.keyframe) {
    if (scale_was_wrong()) publish_anew();
    publish_keyframe();
    const size_t previous = frames_.size() - 2;
    if (newest.stationary && frames_[previous]->stationary) {
      remove_frame(previous);
    } else if (static_cast<int>(frames_.size()) > options_.window) {
      marginalise_oldest();
    }
  }
  return status_;
}

void Estimator::add_frame(int64_t utime, const std::vector<ImuSample>& imu) {
  auto frame = std::make_unique<Frame>();
  frame->id = next_frame_id_++;
  frame->utime = utime;
  frame->time_shift = shared_.state.time_offset[0];
  if (frames_.empty()) {
    frame->state.bg() = gyro_bias_;
  } else {
    const StateValues& last = frames_.back()->state;
    frame->variances = imu_noise_.variances();
    frame->imu = std::make_unique<Preintegration>(last.ba(), last.bg(), frame->variances.applied_to(noise_));
    for (const ImuSample& sample : imu) frame->imu->add(sample);
    const Eigen::Vector3d g(0, 0, -options_.gravity);
    const double T = frame->imu->duration();
    frame->state = last;
    frame->state.p() = last.p() + last.v() * T + 0.5 * T * T * g + last.q() * frame->imu->alpha();
    frame->state.v() = last.v() + T * g + last.q() * frame->imu->beta();
    frame->state.q() = (last.q() * frame->imu->gamma()).normalized();
  }
  frames_.push_back(std::move(frame));
}

void Estimator::add_observations(const std::vector<TrackedFeature>& features, const std::vector<ImuSample>& imu) {
  for (auto& [id, landmark] : landmarks_) landmark.tracked = false;
  // Bearings without a rate beside others with one would say that there is no time offset: those of a first image are
  // left out.
  if (!rates_.see(features, imu, extrinsics_, gyro_bias_)) return;
  Frame* newest = frames_.back().get();
  const StateValues& state = newest->state;
  const Eigen::Matrix3d R_C_W = (state.q().toRotationMatrix() * extrinsics_.R_B_C).transpose();
  const Eigen::Vector3d p_W_C = state.p() + state.q() * extrinsics_.p_B_C;
  const Eigen::Vector3d velocity_C =
      R_C_W * state.v() + rates_.turn_rate().cross(extrinsics_.R_B_C.transpose() * extrinsics_.p_B_C);
  std::map<int64_t, double> inverse_depths;
  std::vector<double> all;
  const bool flying = status_ == Status::kTracking || status_ == Status::kDegraded;
  for (const TrackedFeature& feature : features) {
    const auto known = landmarks_.find(feature.id);
    if (!flying || known == landmarks_.end() || !known->second.has_depth) continue;
    const double depth = (R_C_W * (position_of(known->second) - p_W_C)).z();
    if (depth < kMinDepth) continue;
    all.push_back(inverse_depths[feature.id] = 1 / depth);
  }
  const double usual = all.empty() ? 0 : median(all);
  for (const TrackedFeature& feature : features) {
    Landmark& landmark = landmarks_[feature.id];
    landmark.id = feature.id;
    landmark.tracked = true;
    const auto inverse_depth = inverse_depths.find(feature.id);
    Observation observation{newest, feature.pixel, feature.ray, Eigen::Vector2d::Zero()};
    observation.rate = all.empty()
                           ? rates_.by_differences(feature)
                           : rates_.by_motion(feature, velocity_C,
                                              inverse_depth == inverse_depths.end() ? usual : inverse_depth->second);
    // A shutter that rolls sees the rows of a picture at times of their own.
    observation.ray.head<2>() -= observation.rate * feature.row_delay;
    landmark.observations.push_back(observation);
  }
}

void Estimator::drop_newest() {
  const Frame* frame = frames_.back().get();
  for (auto it = landmarks_.begin(); it != landmarks_.end();) {
    auto& observations = it->second.observations;
    if (!observations.empty() && observations.back().frame == frame) observations.pop_back();
    if (observations.empty()) {
      it = landmarks_.erase(it);
    } else {
      // A depth needs another view than the anchor's.
      if (observations.size() < 2) it->second.has_depth = false;
      ++it;
    }
  }
  frames_.pop_back();
}

double Estimator::parallax_to(const Frame& reference, int* common) const {
  const Frame& newest = *frames_.back();
  const Eigen::Matrix3d R = (reference.state.q().toRotationMatrix() * extrinsics_.R_B_C).transpose() *
                            newest.state.q().toRotationMatrix() * extrinsics_.R_B_C;
  double sum = 0;
  int count = 0;
  for (const auto& [id, landmark] : landmarks_) {
    if (!landmark.tracked || landmark.observations.size() < 2) continue;
    for (const Observation& observation : landmark.observations) {
      if (observation.frame != &reference) continue;
      const Eigen::Vector3d turned = R * landmark.observations.back().ray;
      if (turned.z() > 0.1) {
        sum += focal_ * (turned.head<2>() / turned.z() - observation.ray.head<2>()).norm();
        ++count;
      }
      break;
    }
  }
  if (common) *common = count;
  return count > 0 ? sum / count : 0.0;
}

void Estimator::choose_keyframe() {
  Frame& newest = *frames_.back();
  // Motion counts from the last keyframe that was made because of it.
  size_t reference = frames_.size() - 2;
  while (reference > 0 && frames_[reference]->stationary) --reference;
  const Frame& last = *frames_[reference];
  int common = 0;
  const double parallax = parallax_to(last, &common);
  int in_last = 0, tracked = 0;
  for (const auto& [id, landmark] : landmarks_) {
    if (landmark.tracked) ++tracked;
    for (const Observation& observation : landmark.observations) {
      if (observation.frame == &last) {
        ++in_last;
        break;
      }
    }
  }
  if (tracked < options_.min_landmarks) return;
  newest.keyframe = parallax > options_.keyframe_parallax || common < options_.keyframe_tracked * in_last;
  const int64_t previous = frames_[frames_.size() - 2]->utime;
  if (!newest.keyframe && 1e-6 * static_cast<double>(newest.utime - previous) > options_.keyframe_interval) {
    newest.keyframe = newest.stationary = true;
  }
}

void Estimator::triangulate() {
  const double min_parallax = options_.min_parallax / focal_;
  for (auto& [id, landmark] : landmarks_) {
    if (landmark.has_depth || landmark.observations.size() < 2) continue;
    const Observation& anchor = landmark.anchor();
    const Eigen::Matrix3d R_W_Ci = anchor.frame->state.q().toRotationMatrix() * extrinsics_.R_B_C;
    const Eigen::Vector3d p_i = anchor.frame->state.p() + anchor.frame->state.q() * extrinsics_.p_B_C;
    // Depth along the anchor's ray that the other rays agree on best: the cross products' least squares.
    const Eigen::Vector3d ray = R_W_Ci * anchor.ray;
    double num = 0, den = 0, widest = 0;
    for (size_t k = 1; k < landmark.observations.size(); ++k) {
      const Observation& other = landmark.observations[k];
      const Eigen::Vector3d bearing = (other.frame->state.q() * (extrinsics_.R_B_C * other.ray)).normalized();
      const Eigen::Vector3d step = p_i - other.frame->state.p() - other.frame->state.q() * extrinsics_.p_B_C;
      const Eigen::Vector3d a = bearing.cross(ray), c = bearing.cross(step);
      num -= a.dot(c);
      den += a.squaredNorm();
      widest = std::max(widest, a.norm() / ray.norm());
    }
    if (widest < min_parallax || den <= 0) continue;
    const double depth = num / den;
    if (depth < kMinDepth || depth > 1e4) continue;
    landmark.inverse_depth = 1.0 / depth;
    landmark.has_depth = true;
  }
}

std::vector<Frame*> Estimator::frame_pointers() const {
  std::vector<Frame*> result;
  for (const auto& frame : frames_) result.push_back(frame.get());
  return result;
}

Eigen::Vector3d Estimator::position_of(const Landmark& landmark) const {
  const Observation& anchor = landmark.anchor();
  const Eigen::Vector3d p_B = extrinsics_.R_B_C * anchor.ray / landmark.inverse_depth + extrinsics_.p_B_C;
  return anchor.frame->state.q() * p_B + anchor.frame->state.p();
}

void Estimator::update_height() {
  std::vector<double> heights;
  for (const auto& [id, landmark] : landmarks_) {
    if (!landmark.tracked || !landmark.has_depth) continue;
    heights.push_back(position_of(landmark).z());
  }
  height_ = frames_.back()->state.p().z() - median(heights);
}

}  // namespace orthonav::vio
