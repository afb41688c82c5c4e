// What the estimator keeps an eye on: standstill, wrong features, its own failure, a start that was wrong.
#include <algorithm>
#include <cmath>

#include <fmt/format.h>

#include "common/math/so3.h"
#include "common/math/statistics.h"
#include "services/vio/estimator.h"
#include "services/vio/imu_factor.h"
#include "services/vio/projection_factor.h"

namespace orthonav::vio {

void Estimator::watch_standstill(int64_t utime, const std::vector<TrackedFeature>& features,
                                 const std::vector<ImuSample>& imu) {
  constexpr double kLookBack = 1.0;      // s
  constexpr double kStillPixels = 0.5;   // over that time: the noise of tracking
  constexpr double kFastestStill = 0.3;  // pixels from one frame to the next
  constexpr size_t kFewest = 10;
  Glance now{utime, {}, Eigen::Vector3d::Zero()};
  for (const TrackedFeature& feature : features) now.rays[feature.id] = feature.ray;
  double duration = 0;
  for (size_t k = 1; k < imu.size(); ++k) {
    const double dt = 1e-6 * static_cast<double>(imu[k].utime - imu[k - 1].utime);
    now.gyro += 0.5 * dt * (imu[k].gyro + imu[k - 1].gyro);
    duration += dt;
  }
  if (duration > 0) now.gyro /= duration;
  const auto moved_since = [&](const Glance& then) {
    std::vector<double> moved;
    for (const auto& [id, ray] : now.rays) {
      const auto before = then.rays.find(id);
      if (before != then.rays.end()) moved.push_back(focal_ * (before->second - ray).norm());
    }
    return moved.size() >= kFewest ? quantile(moved, 0.8) : INFINITY;
  };
  const bool at_once = !glances_.empty() && moved_since(glances_.back()) < kFastestStill;
  still_time_ = at_once ? still_time_ + duration : 0;
  while (glances_.size() > 1 && 1e-6 * static_cast<double>(utime - glances_[1].utime) >= kLookBack) {
    glances_.pop_front();
  }
  const bool since_long = !glances_.empty() &&
                          1e-6 * static_cast<double>(utime - glances_.front().utime) <= 1.5 * kLookBack &&
                          moved_since(glances_.front()) < kStillPixels;
  glances_.push_back(std::move(now));
  still_ = at_once && since_long && still_time_ >= 0.5;
  if (!still_) return;
  still_gyro_.setZero();
  double count = 0;
  for (auto glance = glances_.rbegin(); glance != glances_.rend(); ++glance) {
    if (1e-6 * static_cast<double>(utime - glance->utime) > 0.9 * still_time_) break;
    still_gyro_ += glance->gyro;
    ++count;
  }
  if (count > 0) still_gyro_ /= count;
}

void Estimator::find_outliers() {
  const Frame* newest = frames_.back().get();
  in_view_ = refused_ = 0;
  for (auto it = landmarks_.begin(); it != landmarks_.end();) {
    Landmark& landmark = it->second;
    bool wrong = false;
    if (landmark.has_depth && landmark.observations.size() >= 2) {
      double sum = 0, last = 0;
      size_t count = 0;
      wrong = landmark.inverse_depth <= 1e-5;
      for (size_t k = 1; k < landmark.observations.size() && !wrong; ++k) {
        const Observation& other = landmark.observations[k];
        Eigen::Vector2d r;
        if (!ProjectionFactor::evaluate(bearings_of(landmark.anchor(), other), time_offset(), extrinsics_, focal_,
                                        landmark.anchor().frame->state.pose.data(), other.frame->state.pose.data(),
                                        landmark.inverse_depth, &r, nullptr)) {
          wrong = true;
          break;
        }
        sum += r.squaredNorm();
        ++count;
        if (other.frame == newest) last = r.norm();
      }
      landmark.reprojection_error = count > 0 ? std::sqrt(sum / static_cast<double>(count)) : 0;
      wrong = wrong || landmark.reprojection_error > options_.outlier_error || last > 2 * options_.outlier_error;
    }
    in_view_ += landmark.tracked && landmark.has_depth ? 1 : 0;
    if (wrong) {
      if (landmark.tracked) {
        outliers_.insert(landmark.id);
        ++refused_;
      }
      it = landmarks_.erase(it);
    } else {
      ++it;
    }
  }
}

// The noise of tracks from what the solution leaves of them; `share` is how much this counts beside what was known.
void Estimator::measure_noise(double share) {
  std::vector<double> variances;  // pixels^2 per axis
  for (const auto& [id, landmark] : landmarks_) {
    if (!landmark.tracked || !landmark.has_depth || landmark.observations.size() < 3) continue;
    // Two residuals a view beside the anchor, and the depth was fitted to them.
    const auto views = static_cast<double>(landmark.observations.size() - 1);
    variances.push_back(landmark.reprojection_error * landmark.reprojection_error * views / (2 * views - 1));
  }
  if (static_cast<int>(variances.size()) < options_.degraded_landmarks) return;
  const double measured = std::clamp(std::sqrt(median(variances)), options_.pixel_sigma, options_.max_pixel_sigma);
  pixel_sigma_ += share * (measured - pixel_sigma_);
}

// What the motion to the frame at `index` says of the sensor.
ImuVariances Estimator::imu_noise_of(const NormalEquations& equations, size_t index) const {
  const Frame& i = *frames_[index - 1];
  const Frame& j = *frames_[index];
  std::vector<int> rows;
  const auto add = [&](int offset, int size) {
    for (int k = 0; k < size; ++k) rows.push_back(offset + k);
  };
  add(equations.pose_offset(i), 6);
  add(equations.speed_bias_offset(i), 9);
  add(equations.pose_offset(j), 6);
  add(equations.speed_bias_offset(j), 9);
  const Eigen::MatrixXd covariance = equations.covariance(rows);
  ImuFactor::Vector15 residual;
  ImuFactor::Jacobians jacobians;
  ImuFactor::evaluate(*j.imu, i.state, j.state, options_.gravity, &residual, &jacobians);
  Eigen::Matrix<double, 15, 30> J;
  J << jacobians.pose_i, jacobians.speed_bias_i, jacobians.pose_j, jacobians.speed_bias_j;
  ImuFactor::Vector15 unknown = ImuFactor::Vector15::Ones();  // nothing is learnt
  if (covariance.size() > 0) unknown = (J * covariance * J.transpose()).diagonal();
  return ImuNoiseMeter::heard(residual, unknown, j.variances);
}

std::string Estimator::find_failure() {
  const Frame& newest = *frames_.back();
  const Frame& last = *frames_[frames_.size() - 2];
  const int in_view = in_view_ - refused_;
  const double dt = last_frame_utime_ > 0 ? 1e-6 * static_cast<double>(newest.utime - last_frame_utime_) : 0.0;
  last_frame_utime_ = newest.utime;
  if (in_view >= options_.min_landmarks || seen_utime_ == 0) seen_utime_ = newest.utime;
  status_ = in_view < options_.degraded_landmarks ? Status::kDegraded : Status::kTracking;
  reason_ = status_ == Status::kDegraded ? fmt::format("only {} landmarks in view", in_view) : "";
  const StateValues& state = newest.state;
  if (!state.p().allFinite() || !state.v().allFinite() || !state.q().coeffs().allFinite()) {
    return "the estimate is not finite";
  }
  if (1e-6 * static_cast<double>(newest.utime - seen_utime_) > options_.blind_time) {
    return fmt::format("fewer than {} landmarks in view for {:.1f} s", options_.min_landmarks, options_.blind_time);
  }
  if (state.ba().norm() > options_.max_accel_bias) {
    return fmt::format("accelerometer bias of {:.2f} m/s^2", state.ba().norm());
  }
  if (state.bg().norm() > options_.max_gyro_bias) {
    return fmt::format("gyroscope bias of {:.3f} rad/s", state.bg().norm());
  }
  if (state.v().norm() > options_.max_speed) return fmt::format("speed of {:.0f} m/s", state.v().norm());

  // Innovations: what the window's solution leaves of the newest IMU interval, of the newest image, and of what
  // was known before: a motion that does not fit is first made to fit by biases that run. In sound flights the last
  // stays below 0.9, the first below 1 (11 where the sensor's noise is far above its data sheet's), the typical feature
  // fits to a third of a pixel (0.84 at most in 99 of 100, 1.2 while gusts shake a camera at 285 m), and three in a
  // hundred are refused.
  constexpr double kImuError = 25;       // squared standard deviations per dimension
  constexpr double kPriorError = 3;      // standard deviations of the chi-square of all that was known
  constexpr double kRefused = 0.5;       // of the landmarks in view
  constexpr double kTypicalError = 0.4;  // of outlier_error, beside some that are refused
  constexpr double kSomeRefused = 0.05;  // of the landmarks in view
  constexpr double kLargeError = 0.8;    // of outlier_error, whatever is refused
  ImuFactor::Vector15 r;
  ImuFactor::evaluate(*newest.imu, last.state, newest.state, options_.gravity, &r, nullptr);
  const double imu_error = r.squaredNorm() / 15;
  std::vector<double> errors;
  for (const auto& [id, landmark] : landmarks_) {
    if (landmark.tracked && landmark.has_depth) errors.push_back(landmark.reprojection_error);
  }
  const double typical = errors.size() >= 5 ? median(errors) : 0.0;
  const double departure = prior_.departure();
  const auto known = static_cast<double>(std::max<Eigen::Index>(1, prior_.made.size()));
  const bool imu_wrong = imu_error > kImuError || departure > 1 + kPriorError * std::sqrt(2 / known);
  const bool image_wrong = typical > kLargeError * options_.outlier_error ||
                           (typical > kTypicalError * options_.outlier_error && refused_ > kSomeRefused * in_view_) ||
                           (in_view_ >= options_.min_landmarks && refused_ > kRefused * in_view_);
  if (imu_wrong || image_wrong) {
    error_time_ += dt;
  } else if (in_view >= options_.degraded_landmarks) {
    error_time_ = std::max(0.0, error_time_ - dt);  // few features that fit are no proof
  }
  if (error_time_ > options_.max_error_time) {
    return imu_wrong ? fmt::format("camera and IMU contradict each other ({:.0f} standard deviations)",
                                   std::sqrt(std::max(imu_error, departure * known)))
                     : fmt::format("the features do not fit the motion: off by {:.1f} px, {} of {} refused", typical,
                                   refused_, in_view_);
  }
  // A camera that looks down cannot have the ground above it.
  const bool looks_down = (state.q() * extrinsics_.R_B_C.col(2)).z() < -0.8;
  sunk_time_ = looks_down && height_ < 0 ? sunk_time_ + dt : 0;
  if (sunk_time_ > options_.max_error_time) return fmt::format("height above ground of {:.1f} m", height_);
  return "";
}

bool Estimator::scale_was_wrong() const {
  // How the frames that the session started with lie to each other now, and as they did then.
  const Frame* first = nullptr;
  const Frame* last = nullptr;
  for (const auto& frame : frames_) {
    if (!frame->at_start) continue;
    if (!first) first = frame.get();
    last = frame.get();
  }
  if (!first || first == last) return false;
  const double then = (*last->at_start - *first->at_start).norm();
  const double now = (last->state.p() - first->state.p()).norm();
  if (then < 1e-6 || now < 1e-6) return false;
  return std::abs(std::log(now / then)) > options_.max_rescale;
}

}  // namespace orthonav::vio
