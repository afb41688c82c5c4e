// How the window is solved, and what leaves it.
#include <algorithm>
#include <cmath>
#include <limits>

#include <ceres/ceres.h>

#include "common/math/statistics.h"
#include "services/vio/aid_factors.h"
#include "services/vio/estimator.h"
#include "services/vio/imu_factor.h"
#include "services/vio/projection_factor.h"

namespace orthonav::vio {

using Kind = Prior::Block::Kind;

std::vector<Prior::Block> Estimator::blocks_of(const ScaleHint& hint) {
  return {{Kind::kPose, hint.from, nullptr}, {Kind::kPose, hint.to, nullptr}};
}

void Estimator::take_hint() {
  if (!new_hint_) return;
  // The window's longest stretch: from its oldest frame to the newest keyframe.
  Frame* from = frames_.front().get();
  Frame* to = frames_.back().get();
  const double length = (to->state.p() - from->state.p()).norm();
  const auto [ratio, stddev] = *new_hint_;
  if (length > 1e-3) hints_.push_back({from, to, ratio * length, stddev * ratio * length});
  new_hint_.reset();
}

NormalEquations Estimator::normal_equations() {
  NormalEquations equations(frame_pointers(), shared_);
  equations.add_prior(prior_);
  for (size_t k = 1; k < frames_.size(); ++k) equations.add_imu(*frames_[k - 1], *frames_[k], options_.gravity);
  for (const auto& frame : frames_) {
    if (frame->still_sigma) {
      equations.add_cost(StandstillFactor(*frame->still_sigma), {{Kind::kSpeedBias, frame.get(), nullptr}});
    }
  }
  for (const ScaleHint& hint : hints_) {
    equations.add_cost(DistanceFactor(hint.distance, hint.sigma), blocks_of(hint));
  }
  for (const auto& [id, landmark] : landmarks_) {
    if (landmark.has_depth && landmark.observations.size() >= 2) {
      equations.add_landmark(landmark, weight(), options_.robust_width);
    }
  }
  return equations;
}

void Estimator::choose_height_landmark(Frame& frame) {
  if (!frame.height) return;
  if (!shared_.height_free) {
    // The first height of a session brings the bias in.
    shared_.height_free = true;
    SharedUncertainty sigma;
    sigma.height_bias = options_.altitude_bias_sigma;
    add_shared_prior(prior_, shared_, sigma);
  }
  // The landmark that lies in the middle of all, by height.
  std::vector<std::pair<double, int64_t>> heights;
  for (const auto& [id, landmark] : landmarks_) {
    if (!landmark.tracked || !landmark.has_depth || landmark.anchor().frame == &frame) continue;
    heights.emplace_back(position_of(landmark).z(), id);
  }
  if (heights.empty()) return;
  const auto middle = heights.begin() + static_cast<std::ptrdiff_t>(heights.size() / 2);
  std::nth_element(heights.begin(), middle, heights.end());
  frame.height_landmark = middle->second;
}

Estimator::Solution Estimator::optimise(int iterations, double tolerance) {
  for (size_t k = 1; k < frames_.size(); ++k) {
    // The first-order bias correction holds for small changes only.
    const StateValues& state = frames_[k - 1]->state;
    Preintegration& pre = *frames_[k]->imu;
    if ((state.bg() - pre.gyro_bias()).norm() > 2e-3 || (state.ba() - pre.accel_bias()).norm() > 5e-2) {
      pre.repropagate(state.ba(), state.bg());
    }
  }
  PoseManifold manifold;
  DepthManifold depth_manifold;
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
  double* const camera = shared_.state.camera.data();
  double* const time_offset = shared_.state.time_offset.data();
  double* const height_bias = shared_.state.height_bias.data();
  problem.AddParameterBlock(camera, 7, &manifold);
  problem.AddParameterBlock(time_offset, 1);
  ordering->AddElementToGroup(camera, ++group);
  ordering->AddElementToGroup(time_offset, ++group);
  // The few frames of a start would turn the camera by degrees to explain a scale that is not settled yet.
  if (!shared_.camera_free || frames_.front()->at_start) problem.SetParameterBlockConstant(camera);
  if (!shared_.time_free) problem.SetParameterBlockConstant(time_offset);
  if (shared_.height_free) {
    problem.AddParameterBlock(height_bias, 1);
    ordering->AddElementToGroup(height_bias, ++group);
  }
  if (!prior_.empty()) {
    std::vector<double*> blocks;
    for (const Prior::Block& block : prior_.blocks) blocks.push_back(block.value());
    problem.AddResidualBlock(new PriorFactor(prior_), nullptr, blocks);
  }
  for (const auto& frame : frames_) {
    if (!frame->still_sigma) continue;
    problem.AddResidualBlock(new StandstillFactor(*frame->still_sigma), nullptr, frame->state.speed_bias.data());
  }
  for (const ScaleHint& hint : hints_) {
    problem.AddResidualBlock(new DistanceFactor(hint.distance, hint.sigma), nullptr, hint.from->state.pose.data(),
                             hint.to->state.pose.data());
  }
  for (size_t k = 1; k < frames_.size(); ++k) {
    Frame& i = *frames_[k - 1];
    Frame& j = *frames_[k];
    problem.AddResidualBlock(new ImuFactor(*j.imu, options_.gravity), nullptr, i.state.pose.data(),
                             i.state.speed_bias.data(), j.state.pose.data(), j.state.speed_bias.data());
  }
  for (auto& [id, landmark] : landmarks_) {
    if (!landmark.has_depth || landmark.observations.size() < 2) continue;
    const Observation& anchor = landmark.anchor();
    inverse_depths.push_back(landmark.inverse_depth);
    bool added = false;
    for (size_t k = 1; k < landmark.observations.size(); ++k) {
      const Observation& other = landmark.observations[k];
      const Bearings bearings = bearings_of(anchor, other);
      if (!ProjectionFactor::evaluate(bearings, time_offset[0], extrinsics_, weight(), anchor.frame->state.pose.data(),
                                      other.frame->state.pose.data(), landmark.inverse_depth, nullptr, nullptr)) {
        continue;
      }
      problem.AddResidualBlock(new ProjectionFactor(bearings, shared_, extrinsics_, weight()), &loss,
                               anchor.frame->state.pose.data(), other.frame->state.pose.data(), &inverse_depths.back(),
                               camera, time_offset);
      added = true;
    }
    if (added && shared_.height_free) {
      for (const auto& frame : frames_) {
        if (!frame->height || frame->height_landmark != id || frame.get() == anchor.frame) continue;
        problem.AddResidualBlock(new HeightFactor(*frame->height, anchor.ray, extrinsics_), nullptr,
                                 anchor.frame->state.pose.data(), frame->state.pose.data(), &inverse_depths.back(),
                                 height_bias);
      }
    }
    if (added) {
      problem.SetManifold(&inverse_depths.back(), &depth_manifold);
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
  // The damping must stay far below what the least known direction is known by: with a radius of 10^6 the scale, known
  // to a percent beside pixels that know their poses to millimetres, stayed where it was.
  options.initial_trust_region_radius = 1e10;
  options.max_num_iterations = iterations;
  options.function_tolerance = tolerance;
  // Steps that go up for a while get through the bends of a start's valley (scale against tilt and the accelerometer's
  // bias): 40 iterations where 200 without them stop half way, which looks like a start at half the scale.
  options.use_nonmonotonic_steps = status_ == Status::kInitialising;
  options.num_threads = 1;
  options.logging_type = ceres::SILENT;
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem, &summary);
  for (size_t k = 0; k < solved.size(); ++k) solved[k]->inverse_depth = inverse_depths[k];
  if (shared_.camera_free) extrinsics_ = shared_.state.extrinsics();
  time_offset[0] = std::clamp(time_offset[0], options_.time_offset - options_.max_time_offset,
                              options_.time_offset + options_.max_time_offset);
  return {summary.termination_type == ceres::CONVERGENCE,
          summary.IsSolutionUsable() ? summary.final_cost : std::numeric_limits<double>::infinity()};
}

// Takes a frame's observation out of a landmark that is still seen; a landmark that is anchored there is anchored at
// its next observation, at the depth it has there.
void Estimator::leave_frame(Landmark& landmark, const Frame& leaving) {
  auto& observations = landmark.observations;
  if (landmark.anchor().frame == &leaving && observations.size() > 1 && landmark.has_depth) {
    const Eigen::Vector3d p_W = position_of(landmark);
    const StateValues& next = observations[1].frame->state;
    const Eigen::Vector3d p_C =
        extrinsics_.R_B_C.transpose() * (next.q().conjugate() * (p_W - next.p()) - extrinsics_.p_B_C);
    if (p_C.z() > 0.05) {
      landmark.inverse_depth = 1.0 / p_C.z();
    } else {
      landmark.has_depth = false;
    }
  }
  std::erase_if(observations, [&](const Observation& observation) { return observation.frame == &leaving; });
  if (observations.size() < 2) landmark.has_depth = false;
}

void Estimator::marginalise_oldest() {
  Frame& oldest = *frames_.front();
  NormalEquations equations(frame_pointers(), shared_);
  equations.add_prior(prior_);
  equations.add_imu(oldest, *frames_[1], options_.gravity);
  if (oldest.still_sigma) {
    equations.add_cost(StandstillFactor(*oldest.still_sigma), {{Kind::kSpeedBias, &oldest, nullptr}});
  }
  for (const ScaleHint& hint : hints_) {
    if (hint.from == &oldest) {
      equations.add_cost(DistanceFactor(hint.distance, hint.sigma), blocks_of(hint));
    }
  }
  for (auto it = landmarks_.begin(); it != landmarks_.end();) {
    Landmark& landmark = it->second;
    if (landmark.anchor().frame != &oldest) {
      ++it;
      continue;
    }
    if (!landmark.tracked || landmark.observations.size() < 2) {
      if (landmark.has_depth && landmark.observations.size() >= 2) {
        equations.add_landmark(landmark, weight(), options_.robust_width);
      }
      it = landmarks_.erase(it);
      continue;
    }
    leave_frame(landmark, oldest);
    ++it;
  }
  prior_ = equations.marginalise(oldest);
  std::erase_if(hints_, [&](const ScaleHint& hint) { return hint.from == &oldest; });
  frames_.erase(frames_.begin());
  frames_.front()->imu.reset();
}

// Takes a frame out of the middle: what the prior knows of the others stays, its images are forgotten, its IMU samples
// join those of the frame after it.
void Estimator::remove_frame(size_t index) {
  Frame& leaving = *frames_[index];
  if (prior_.holds(leaving)) {
    NormalEquations equations(frame_pointers(), shared_);
    equations.add_prior(prior_);
    prior_ = equations.marginalise(leaving);
  }
  leaving.imu->append(*frames_[index + 1]->imu);
  frames_[index + 1]->imu = std::move(leaving.imu);
  for (auto it = landmarks_.begin(); it != landmarks_.end();) {
    leave_frame(it->second, leaving);
    it = it->second.observations.empty() ? landmarks_.erase(it) : std::next(it);
  }
  std::erase_if(hints_, [&](const ScaleHint& hint) { return hint.from == &leaving || hint.to == &leaving; });
  frames_.erase(frames_.begin() + static_cast<std::ptrdiff_t>(index));
}

}  // namespace orthonav::vio
