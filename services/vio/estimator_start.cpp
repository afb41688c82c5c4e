// How the estimator starts: collects frames, tries the closed form, refines, and decides whether to trust it.
#include <algorithm>
#include <cmath>
#include <string>

#include <fmt/format.h>

#include "common/math/statistics.h"
#include "services/vio/estimator.h"
#include "services/vio/flat_start.h"
#include "services/vio/initialiser.h"

namespace orthonav::vio {
namespace {

constexpr double kStartTolerance = 1e-9;
constexpr int kStartIterations = 60;
constexpr double kTypicalError = 0.25;  // of a feature in a start, of outlier_error
constexpr int kNoiseSteps = 8;          // of learning the sensor's noise, of one try
constexpr double kTryInterval = 0.2;    // s: a start is tried more often than its frames are kept

std::string too_uncertain(double scale_sigma) {
  return fmt::format("not enough acceleration yet: scale is uncertain by {:.0f} %", 100 * scale_sigma);
}

}  // namespace

void Estimator::collect_for_start() {
  Frame& newest = *frames_.back();
  if (still_ && newest.imu) {
    // At rest the gyroscope reads its bias. Motion begins from the last frame at rest.
    gyro_bias_ = still_gyro_;
    gyro_bias_sigma_ = 2e-3;
    gyro_bias_known_ = true;
    while (frames_.size() > 1) frames_.erase(frames_.begin());
    newest.imu.reset();
    newest.keyframe = newest.at_rest = true;
    newest.state.bg() = gyro_bias_;
    for (auto it = landmarks_.begin(); it != landmarks_.end();) {
      Landmark& landmark = it->second;
      if (!landmark.tracked) {
        it = landmarks_.erase(it);
        continue;
      }
      landmark.observations.erase(landmark.observations.begin(), landmark.observations.end() - 1);
      ++it;
    }
    reason_ = "standing still";
    return;
  }

  if (frames_.size() == 1) {
    newest.keyframe = true;
    reason_ = "waiting for motion";
    return;
  }
  const Frame& last = *frames_[frames_.size() - 2];
  int common = 0;
  const double parallax = parallax_to(last, &common);
  if (common < options_.min_landmarks) {
    // The chain of tracks is broken: begin again here.
    reason_ = "too few features tracked";
    while (frames_.size() > 1) frames_.erase(frames_.begin());
    newest.imu.reset();
    newest.keyframe = true;
    std::erase_if(landmarks_, [](const auto& entry) { return !entry.second.tracked; });
    for (auto& [id, landmark] : landmarks_) {
      landmark.observations.erase(landmark.observations.begin(), landmark.observations.end() - 1);
    }
    return;
  }
  const double interval = 1e-6 * static_cast<double>(newest.utime - last.utime);
  newest.keyframe = interval > options_.init_interval - 1e-3 || parallax > options_.init_parallax;
  const bool due = 1e-6 * static_cast<double>(newest.utime - tried_utime_) > kTryInterval - 1e-3;
  if (!newest.keyframe && !due) return;
  // Into the second frame, which stays: the ground that is measured is anchored in the first.
  if (newest.keyframe && frames_.size() == 2 && !newest.height) recall_height(newest);
  tried_utime_ = newest.utime;
  if (newest.keyframe && static_cast<int>(frames_.size()) > options_.window) thin_out();
  const double span = 1e-6 * static_cast<double>(newest.utime - frames_.front()->utime);
  if (span < options_.init_min_time || frames_.size() < 4) {
    reason_ = "collecting motion";
    return;
  }
  start_due_ = true;
}

void Estimator::try_start() {
  start_due_ = false;
  if (!solve_start()) return;
  status_ = Status::kTracking;
  reason_.clear();
  const Frame& newest = *frames_.back();
  seen_utime_ = newest.utime;
  gyro_bias_ = newest.state.bg();
  gyro_bias_known_ = true;
  for (const auto& frame : frames_) frame->at_start = frame->state.p();
}

void Estimator::recall_height(Frame& frame) const {
  constexpr double kClimb = 1.5;   // m/s, 1 sigma of how the climb changes
  constexpr double kLongest = 10;  // s, after which nothing is left of it
  if (!memory_) return;
  const double elapsed = 1e-6 * static_cast<double>(frame.utime - memory_->utime);
  if (elapsed < 0 || elapsed > kLongest) return;
  const double height = memory_->height + memory_->climb * elapsed;
  if (height <= 0) return;
  const double stddev = std::hypot(memory_->height_stddev, kClimb * elapsed);
  frame.height = HeightMeasurement{height, std::hypot(stddev, options_.altitude_relief)};
}

void Estimator::thin_out() {
  // A longer stretch makes the scale better known, as long as it is held together by features seen throughout.
  int throughout = 0;
  for (const auto& [id, landmark] : landmarks_) {
    throughout += landmark.tracked && landmark.anchor().frame == frames_.front().get() ? 1 : 0;
  }
  size_t leaving = 0;
  if (throughout >= options_.degraded_landmarks) {
    double shortest = INFINITY;
    for (size_t k = 1; k + 1 < frames_.size(); ++k) {
      const double interval = static_cast<double>(frames_[k + 1]->utime - frames_[k - 1]->utime);
      if (interval < shortest) {
        shortest = interval;
        leaving = k;
      }
    }
    frames_[leaving]->imu->append(*frames_[leaving + 1]->imu);
    frames_[leaving + 1]->imu = std::move(frames_[leaving]->imu);
  } else {
    frames_[1]->imu.reset();
  }
  for (auto it = landmarks_.begin(); it != landmarks_.end();) {
    auto& observations = it->second.observations;
    std::erase_if(observations, [&](const Observation& o) { return o.frame == frames_[leaving].get(); });
    it = observations.empty() ? landmarks_.erase(it) : std::next(it);
  }
  frames_.erase(frames_.begin() + static_cast<std::ptrdiff_t>(leaving));
}

bool Estimator::solve_start() {
  const SharedValues before = shared_.state;
  const ImuNoiseMeter noise_before = imu_noise_;
  const auto give_up = [&](const std::string& why) {
    reason_ = why;
    imu_noise_ = noise_before;
    weigh_imu();
    shared_.state = before;
    extrinsics_ = before.extrinsics();
    for (auto& [id, landmark] : landmarks_) landmark.has_depth = false;
    for (const auto& frame : frames_) {
      frame->state = StateValues{};
      frame->state.bg() = gyro_bias_;
      frame->still_sigma.reset();
    }
    prior_ = {};
    // Rotations are needed for parallax: the gyroscope's, from the first frame on.
    for (size_t k = 1; k < frames_.size(); ++k) {
      frames_[k]->state.q() = frames_[k - 1]->state.q() * frames_[k]->imu->corrected_gamma(gyro_bias_);
    }
    return false;
  };
  LinearStart start = solve_linear_start(frame_pointers(), landmarks_, extrinsics_, options_.gravity, gyro_bias_,
                                         gyro_bias_known_ ? gyro_bias_sigma_ : std::max(0.1, gyro_bias_sigma_),
                                         options_.accel_bias_sigma, weight(), pixel_sigma_);
  if (!start.ok || start.residual > options_.outlier_error) {
    const LinearStart flat =
        solve_flat_start(frame_pointers(), landmarks_, extrinsics_, options_.gravity, start.gyro_bias, focal_);
    if (flat.ok) start = flat;
  }
  if (!start.ok) return give_up(start.reason);
  if (start.residual > options_.outlier_error) {
    return give_up(fmt::format("the motion does not fit the IMU ({:.1f} px)", start.residual));
  }
  if (frames_.front()->at_rest) {
    // A motion that begins from rest has no velocity to be found: so fast, in pixels, it may have begun unseen.
    constexpr double kUnseen = 2.0;  // pixels/s
    std::vector<double> depths;
    for (const auto& [id, landmark] : landmarks_) {
      if (landmark.has_depth) depths.push_back(1 / landmark.inverse_depth);
    }
    frames_.front()->still_sigma = 0.01 + kUnseen * median(depths) / focal_;
  }
  const double gyro_sigma = gyro_bias_known_ ? gyro_bias_sigma_ : std::max(0.1, gyro_bias_sigma_);
  start_prior(before, gyro_sigma);
  for (const auto& frame : frames_) choose_height_landmark(*frame);
  // To the bottom: scale lies in a shallow direction of the cost.
  optimise(kStartIterations, kStartTolerance);
  // Position and yaw stay at the first frame; its attitude and biases have moved.
  start_prior(before, gyro_sigma);
  find_outliers();
  measure_noise(1.0);
  // A sensor that is as its data sheet says takes one look.
  for (int step = 0; step < kNoiseSteps && learn_imu_noise(); ++step) optimise(kStartIterations, kStartTolerance);
  // Far from enough: no need for a second solution, which costs as much as ten frames.
  const double first_sigma = scale_sigma(normal_equations());
  if (first_sigma > 4 * options_.init_scale_sigma) return give_up(too_uncertain(first_sigma));
  triangulate();
  const Solution solution = optimise(kStartIterations, kStartTolerance);
  find_outliers();

  std::vector<double> errors;
  for (const auto& [id, landmark] : landmarks_) {
    if (landmark.has_depth && landmark.observations.size() >= 2) errors.push_back(landmark.reprojection_error);
  }
  if (static_cast<int>(errors.size()) < options_.degraded_landmarks) return give_up("too few features fit");
  if (median(errors) > kTypicalError * options_.outlier_error) {
    return give_up(fmt::format("features do not fit the motion ({:.1f} px)", median(errors)));
  }
  const StateValues& state = frames_.back()->state;
  if (state.ba().norm() > options_.max_accel_bias || state.bg().norm() > options_.max_gyro_bias ||
      state.v().norm() > options_.max_speed) {
    return give_up("the biases or the speed found are not plausible");
  }
  const double sigma_scale = scale_sigma(normal_equations());
  if (!(sigma_scale < options_.init_scale_sigma)) {
    return give_up(too_uncertain(sigma_scale));
  }
  // Half way up its valley a start is at the wrong scale, and surer of it than at the right one.
  if (!solution.converged) return give_up("the motion is not settled yet");
  if (fits_better_at_another_scale(solution.cost)) return give_up("another scale fits better");
  outliers_.clear();
  return true;
}

// Integrates the window's motions with the noise that the sensor is known to have.
void Estimator::weigh_imu() {
  const ImuVariances& variances = imu_noise_.variances();
  for (size_t k = 1; k < frames_.size(); ++k) {
    if (frames_[k]->variances == variances) continue;
    frames_[k]->variances = variances;
    frames_[k]->imu->reweigh(variances.applied_to(noise_));
  }
}

// A step towards the noise that the motions of a start say the sensor has; whether it was a long one.
bool Estimator::learn_imu_noise() {
  constexpr double kLong = 1.1;  // of a variance
  const NormalEquations equations = normal_equations();
  const ImuVariances before = imu_noise_.variances();
  ImuVariances mean{0, 0};
  const double share = 1 / static_cast<double>(frames_.size() - 1);
  for (size_t k = 1; k < frames_.size(); ++k) {
    const ImuVariances one = imu_noise_of(equations, k);
    mean.gyro += share * one.gyro;
    mean.accel += share * one.accel;
  }
  imu_noise_.learn(mean, 1);
  weigh_imu();
  const ImuVariances& now = imu_noise_.variances();
  return now.gyro > kLong * before.gyro || now.accel > kLong * before.accel;
}

// A start can settle in a wrong optimum (5 times too small, and sure of it to 4 %). The window is solved again from the
// same motion made smaller and larger: what is right comes back to where it was.
bool Estimator::fits_better_at_another_scale(double cost) {
  constexpr double kFactors[] = {0.4, 2.5};
  const SharedValues shared = shared_.state;
  std::vector<StateValues> states;
  for (const auto& frame : frames_) states.push_back(frame->state);
  std::map<int64_t, double> inverse_depths;
  for (const auto& [id, landmark] : landmarks_) inverse_depths[id] = landmark.inverse_depth;
  bool better = false;
  for (const double factor : kFactors) {
    for (size_t k = 0; k < frames_.size(); ++k) {
      frames_[k]->state = states[k];
      frames_[k]->state.p() = states[0].p() + factor * (states[k].p() - states[0].p());
      frames_[k]->state.v() *= factor;
    }
    for (auto& [id, landmark] : landmarks_) landmark.inverse_depth = inverse_depths[id] / factor;
    const Solution other = optimise(kStartIterations, kStartTolerance);
    better = better || other.cost < cost - 1;
  }
  for (size_t k = 0; k < frames_.size(); ++k) frames_[k]->state = states[k];
  for (auto& [id, landmark] : landmarks_) landmark.inverse_depth = inverse_depths[id];
  shared_.state = shared;
  extrinsics_ = shared.extrinsics();
  return better;
}

void Estimator::start_prior(const SharedValues& shared, double gyro_sigma) {
  InitialUncertainty sigma;
  sigma.accel_bias = options_.accel_bias_sigma;
  sigma.gyro_bias = gyro_sigma;
  prior_ = make_initial_prior(*frames_.front(), sigma, Eigen::Vector3d::Zero(), gyro_bias_);
  shared_.state = shared;
  extrinsics_ = shared.extrinsics();
  SharedUncertainty uncertain;
  uncertain.camera_rotation = options_.extrinsics_sigma_deg * 3.14159265358979323846 / 180;
  uncertain.camera_position = options_.extrinsics_sigma_m;
  uncertain.time_offset = options_.time_offset_sigma;
  uncertain.height_bias = options_.altitude_bias_sigma;
  add_shared_prior(prior_, shared_, uncertain);
}

double Estimator::scale_sigma(const NormalEquations& equations) const {
  // Of the longest way between two frames, which visual information alone leaves free.
  const Frame* a = frames_.front().get();
  const Frame* b = nullptr;
  double longest = 0;
  for (const auto& frame : frames_) {
    const double distance = (frame->state.p() - a->state.p()).norm();
    if (distance > longest) {
      longest = distance;
      b = frame.get();
    }
  }
  if (!b || longest < 1e-3) return INFINITY;
  const Eigen::MatrixXd joint = equations.pose_covariance({equations.pose_offset(*a), equations.pose_offset(*b)});
  if (joint.size() == 0) return INFINITY;
  const Eigen::Vector3d direction = (b->state.p() - a->state.p()) / longest;
  Eigen::Matrix<double, 12, 1> J = Eigen::Matrix<double, 12, 1>::Zero();
  J.segment<3>(0) = -direction;
  J.segment<3>(6) = direction;
  return std::sqrt((J.transpose() * joint * J).value()) / longest;
}

}  // namespace orthonav::vio
