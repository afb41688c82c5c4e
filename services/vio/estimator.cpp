#include "services/vio/estimator.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include <ceres/ceres.h>
#include <fmt/format.h>

#include "common/math/so3.h"
#include "common/math/statistics.h"
#include "services/vio/imu_factor.h"
#include "services/vio/projection_factor.h"

namespace orthonav::vio {
namespace {

constexpr double kTolerance = 1e-4;  // relative decrease of the cost at which a frame's solution is good enough

}  // namespace

Estimator::Estimator(const EstimatorOptions& options, const Extrinsics& extrinsics, const ImuNoise& noise, double focal)
    : options_(options), extrinsics_(extrinsics), noise_(noise), focal_(focal) {
  gyro_bias_sigma_ = options.gyro_bias_sigma;
  reset();
}

void Estimator::reset() {
  status_ = Status::kInitialising;
  frames_.clear();
  landmarks_.clear();
  prior_ = {};
  last_pixels_.clear();
  still_time_ = 0;
  still_samples_ = 0;
  still_gyro_sum_.setZero();
  next_frame_id_ = 0;
  next_keyframe_id_ = 0;
  height_ = std::numeric_limits<double>::quiet_NaN();
  pose_covariance_.setConstant(std::numeric_limits<double>::quiet_NaN());
  q_P_W_.setIdentity();
  p_P_W_.setZero();
  newest_ = StateValues{};
  published_.reset();
  outliers_.clear();
}

Estimator::Status Estimator::process(int64_t utime, const std::vector<TrackedFeature>& features,
                                     const std::vector<ImuSample>& imu) {
  published_.reset();
  outliers_.clear();
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
  add_observations(features);
  if (status_ == Status::kInitialising) {
    collect_for_start(features);
    return status_;
  }
  Frame& newest = *frames_.back();
  newest.keyframe = wants_keyframe();
  triangulate();
  optimise(options_.iterations, kTolerance);
  find_outliers();
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
    publish_keyframe();
    if (static_cast<int>(frames_.size()) > options_.window) marginalise_oldest();
  }
  return status_;
}

void Estimator::add_frame(int64_t utime, const std::vector<ImuSample>& imu) {
  auto frame = std::make_unique<Frame>();
  frame->id = next_frame_id_++;
  frame->utime = utime;
  if (frames_.empty()) {
    frame->state.bg() = gyro_bias_;
  } else {
    const StateValues& last = frames_.back()->state;
    frame->imu = std::make_unique<Preintegration>(last.ba(), last.bg(), noise_);
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

void Estimator::add_observations(const std::vector<TrackedFeature>& features) {
  for (auto& [id, landmark] : landmarks_) landmark.tracked = false;
  for (const TrackedFeature& feature : features) {
    Landmark& landmark = landmarks_[feature.id];
    landmark.id = feature.id;
    landmark.tracked = true;
    landmark.observations.push_back({frames_.back().get(), feature.pixel, feature.ray});
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

bool Estimator::wants_keyframe() const {
  const Frame& last = *frames_[frames_.size() - 2];
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
  if (tracked < options_.min_landmarks) return false;
  return parallax > options_.keyframe_parallax || common < options_.keyframe_tracked * in_last;
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
    if (depth < 0.1 || depth > 1e4) continue;
    landmark.inverse_depth = 1.0 / depth;
    landmark.has_depth = true;
  }
}

std::vector<Frame*> Estimator::frame_pointers() const {
  std::vector<Frame*> result;
  for (const auto& frame : frames_) result.push_back(frame.get());
  return result;
}

NormalEquations Estimator::normal_equations() const {
  NormalEquations equations(frame_pointers());
  equations.add_prior(prior_);
  for (size_t k = 1; k < frames_.size(); ++k) equations.add_imu(*frames_[k - 1], *frames_[k], options_.gravity);
  for (const auto& [id, landmark] : landmarks_) {
    if (landmark.has_depth && landmark.observations.size() >= 2) {
      equations.add_landmark(landmark, extrinsics_, weight(), options_.robust_width);
    }
  }
  return equations;
}

void Estimator::optimise(int iterations, double tolerance) {
  for (size_t k = 1; k < frames_.size(); ++k) {
    // The first-order bias correction holds for small changes only.
    const StateValues& state = frames_[k - 1]->state;
    Preintegration& pre = *frames_[k]->imu;
    if ((state.bg() - pre.gyro_bias()).norm() > 2e-3 || (state.ba() - pre.accel_bias()).norm() > 5e-2) {
      pre.repropagate(state.ba(), state.bg());
    }
  }
  PoseManifold manifold;
  ceres::HuberLoss loss(options_.robust_width);
  ceres::Problem::Options problem_options;
  problem_options.manifold_ownership = ceres::DO_NOT_TAKE_OWNERSHIP;
  problem_options.loss_function_ownership = ceres::DO_NOT_TAKE_OWNERSHIP;
  problem_options.disable_all_safety_checks = true;
  ceres::Problem problem(problem_options);
  // Ceres eliminates the blocks of a group in the order of their addresses, and a replay must repeat bit for bit
  // whatever the heap looks like: each state is a group of its own, and the depths lie in a row.
  auto ordering = std::make_shared<ceres::ParameterBlockOrdering>();
  int group = 0;
  for (const auto& frame : frames_) {
    problem.AddParameterBlock(frame->state.pose.data(), 7, &manifold);
    problem.AddParameterBlock(frame->state.speed_bias.data(), 9);
    ordering->AddElementToGroup(frame->state.pose.data(), ++group);
    ordering->AddElementToGroup(frame->state.speed_bias.data(), ++group);
  }
  std::vector<double> inverse_depths;
  std::vector<Landmark*> solved;
  inverse_depths.reserve(landmarks_.size());
  if (!prior_.empty()) {
    std::vector<double*> blocks;
    for (const Prior::Block& block : prior_.blocks) {
      blocks.push_back(block.speed_bias ? block.frame->state.speed_bias.data() : block.frame->state.pose.data());
    }
    problem.AddResidualBlock(new PriorFactor(prior_), nullptr, blocks);
  }
  for (size_t k = 1; k < frames_.size(); ++k) {
    Frame& i = *frames_[k - 1];
    Frame& j = *frames_[k];
    problem.AddResidualBlock(new ImuFactor(*j.imu, i, j, options_.gravity), nullptr, i.state.pose.data(),
                             i.state.speed_bias.data(), j.state.pose.data(), j.state.speed_bias.data());
  }
  for (auto& [id, landmark] : landmarks_) {
    if (!landmark.has_depth || landmark.observations.size() < 2) continue;
    const Observation& anchor = landmark.anchor();
    inverse_depths.push_back(landmark.inverse_depth);
    bool added = false;
    for (size_t k = 1; k < landmark.observations.size(); ++k) {
      const Observation& other = landmark.observations[k];
      if (!ProjectionFactor::evaluate(anchor.ray, other.ray, extrinsics_, weight(), anchor.frame->state.pose.data(),
                                      other.frame->state.pose.data(), landmark.inverse_depth, nullptr, nullptr)) {
        continue;
      }
      problem.AddResidualBlock(
          new ProjectionFactor(anchor.ray, other.ray, extrinsics_, weight(), *anchor.frame, *other.frame), &loss,
          anchor.frame->state.pose.data(), other.frame->state.pose.data(), &inverse_depths.back());
      added = true;
    }
    if (added) {
      ordering->AddElementToGroup(&inverse_depths.back(), 0);
      solved.push_back(&landmark);
    } else {
      inverse_depths.pop_back();
    }
  }
  ceres::Solver::Options options;
  options.linear_solver_type = ceres::DENSE_SCHUR;
  options.linear_solver_ordering = ordering;
  options.trust_region_strategy_type = ceres::LEVENBERG_MARQUARDT;
  options.initial_trust_region_radius = 1e6;
  options.max_num_iterations = iterations;
  options.function_tolerance = tolerance;
  options.num_threads = 1;
  options.logging_type = ceres::SILENT;
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem, &summary);
  for (size_t k = 0; k < solved.size(); ++k) solved[k]->inverse_depth = inverse_depths[k];
}

void Estimator::find_outliers() {
  const Frame* newest = frames_.back().get();
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
        if (!ProjectionFactor::evaluate(landmark.anchor().ray, other.ray, extrinsics_, focal_,
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
    if (wrong) {
      if (landmark.tracked) outliers_.insert(landmark.id);
      it = landmarks_.erase(it);
    } else {
      ++it;
    }
  }
}

std::string Estimator::find_failure() {
  const Frame& newest = *frames_.back();
  int in_view = 0;
  for (const auto& [id, landmark] : landmarks_) in_view += landmark.tracked && landmark.has_depth ? 1 : 0;
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
  return "";
}

void Estimator::update_height() {
  std::vector<double> heights;
  for (const auto& [id, landmark] : landmarks_) {
    if (!landmark.tracked || !landmark.has_depth) continue;
    const Observation& anchor = landmark.anchor();
    const Eigen::Vector3d p_B = extrinsics_.R_B_C * anchor.ray / landmark.inverse_depth + extrinsics_.p_B_C;
    heights.push_back((anchor.frame->state.q() * p_B + anchor.frame->state.p()).z());
  }
  height_ = frames_.back()->state.p().z() - median(heights);
}

void Estimator::marginalise_oldest() {
  Frame& oldest = *frames_.front();
  NormalEquations equations(frame_pointers());
  equations.add_prior(prior_);
  equations.add_imu(oldest, *frames_[1], options_.gravity);
  for (auto it = landmarks_.begin(); it != landmarks_.end();) {
    Landmark& landmark = it->second;
    if (landmark.anchor().frame != &oldest) {
      ++it;
      continue;
    }
    if (!landmark.tracked || landmark.observations.size() < 2) {
      if (landmark.has_depth && landmark.observations.size() >= 2) {
        equations.add_landmark(landmark, extrinsics_, weight(), options_.robust_width);
      }
      it = landmarks_.erase(it);
      continue;
    }
    // Still seen: anchored at its next observation, at the depth it has there.
    if (landmark.has_depth) {
      const Eigen::Vector3d p_B =
          extrinsics_.R_B_C * landmark.anchor().ray / landmark.inverse_depth + extrinsics_.p_B_C;
      const Eigen::Vector3d p_W = oldest.state.q() * p_B + oldest.state.p();
      const StateValues& next = landmark.observations[1].frame->state;
      const Eigen::Vector3d p_C =
          extrinsics_.R_B_C.transpose() * (next.q().conjugate() * (p_W - next.p()) - extrinsics_.p_B_C);
      if (p_C.z() > 0.05) {
        landmark.inverse_depth = 1.0 / p_C.z();
      } else {
        landmark.has_depth = false;
      }
    }
    landmark.observations.erase(landmark.observations.begin());
    if (landmark.observations.size() < 2) landmark.has_depth = false;
    ++it;
  }
  prior_ = equations.marginalise(oldest);
  frames_.erase(frames_.begin());
  frames_.front()->imu.reset();
}

}  // namespace orthonav::vio
