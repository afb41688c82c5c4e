#include "services/vio/estimator.h"

#include <gtest/gtest.h>

#include "common/math/align.h"
#include "common/math/so3.h"
#include "common/math/statistics.h"
#include "tests/vio/simulated_flight.h"

namespace orthonav::vio {
namespace {

using Eigen::Vector3d;

struct Flown {
  std::vector<Vector3d> estimate, truth;
  std::vector<Keyframe> keyframes;
  double started = -1;      // s
  double height_error = 0;  // relative, at the start
  Vector3d gyro_bias, accel_bias;
  bool failed = false;
};

Flown fly(const Trajectory& trajectory, const std::vector<SimulatedFrame>& frames) {
  Estimator estimator({}, downward_camera(), {}, test_camera().focal());
  Flown flown;
  for (const SimulatedFrame& frame : frames) {
    const auto status = process(estimator, frame);
    if (status == Estimator::Status::kFailed) {
      flown.failed = true;
      break;
    }
    if (status == Estimator::Status::kInitialising) continue;
    const double height = trajectory.position(frame.t).z();
    if (flown.started < 0) {
      flown.started = frame.t;
      flown.height_error = estimator.height_above_ground() / height - 1;
    }
    flown.estimate.emplace_back(estimator.newest().p());
    flown.truth.push_back(trajectory.position(frame.t));
    if (estimator.keyframe()) flown.keyframes.push_back(*estimator.keyframe());
    flown.gyro_bias = estimator.newest().bg();
    flown.accel_bias = estimator.newest().ba();
  }
  return flown;
}

double largest_error(const Flown& flown) {
  const Similarity fit = align_yaw_translation(flown.estimate, flown.truth);
  double largest = 0;
  for (size_t i = 0; i < flown.truth.size(); ++i) {
    largest = std::max(largest, (fit * flown.estimate[i] - flown.truth[i]).norm());
  }
  return largest;
}

TEST(Estimator, RecoversTheTruthToCentimetresFromPerfectDataOverFlatGround) {
  const Trajectory trajectory = survey_flight(110, 2.6);
  const Flown flown = fly(trajectory, simulate_frames(trajectory, 60, 0.0, {}, 1));
  ASSERT_GE(flown.started, 0);
  EXPECT_LT(flown.started, 10);
  ASSERT_GT(flown.truth.size(), 450u);
  EXPECT_LT(largest_error(flown), 0.05);
}

TEST(Estimator, RecoversTheTruthToCentimetresInARoom) {
  const Trajectory trajectory = survey_flight(2.0, 0.4);
  const Flown flown = fly(trajectory, simulate_frames(trajectory, 30, 0.3, {}, 1));
  ASSERT_GE(flown.started, 0);
  EXPECT_LT(largest_error(flown), 0.02);
}

TEST(Estimator, FindsTheBiases) {
  const Trajectory trajectory = survey_flight(60, 3);
  SimulatedNoise noise;
  noise.gyro_bias = {0.03, -0.02, 0.01};
  noise.accel_bias = {0.05, -0.04, 0.06};
  const Flown flown = fly(trajectory, simulate_frames(trajectory, 60, 2.0, noise, 2));
  ASSERT_GE(flown.started, 0);
  EXPECT_LT((flown.gyro_bias - noise.gyro_bias).norm(), 2e-4);
  EXPECT_LT((flown.accel_bias - noise.accel_bias).norm(), 2e-2);
}

TEST(Estimator, StartsInFlightOverFlatGroundWithTheRightScale) {
  std::vector<double> errors;
  for (const double height : {60.0, 110.0, 285.0}) {
    const Trajectory trajectory = survey_flight(height, height / 40);
    for (unsigned seed = 1; seed <= 3; ++seed) {
      SimulatedNoise noise{0.2, true, {0.004, -0.006, 0.003}, {0.03, -0.02, 0.02}};
      const Flown flown = fly(trajectory, simulate_frames(trajectory, 20, 0.0, noise, seed));
      ASSERT_GE(flown.started, 0) << height << " m, seed " << seed;
      EXPECT_LT(std::abs(flown.height_error), 0.2) << height << " m, seed " << seed;
      EXPECT_FALSE(flown.failed);
      errors.push_back(std::abs(flown.height_error));
    }
  }
  EXPECT_LT(median(errors), 0.07);
}

TEST(Estimator, StartsFromStandstill) {
  const Trajectory trajectory = survey_flight(1.5, 0.5, 3.0);
  SimulatedNoise noise{0.1, true, {0.02, -0.05, 0.03}, {0.03, -0.02, 0.02}};
  const Flown flown = fly(trajectory, simulate_frames(trajectory, 15, 0.1, noise, 3));
  ASSERT_GE(flown.started, 3.0);
  EXPECT_LT(flown.started, 10.0);
  EXPECT_LT(std::abs(flown.height_error), 0.1);
}

TEST(Estimator, StandingStillTellsTheGyroscopesBiasAndStartsNothing) {
  const Trajectory trajectory = survey_flight(1.5, 0.5, 100.0);
  SimulatedNoise noise{0.1, true, {0.02, -0.05, 0.03}, {0.03, -0.02, 0.02}};
  Estimator estimator({}, downward_camera(), {}, test_camera().focal());
  for (const SimulatedFrame& frame : simulate_frames(trajectory, 5, 0.1, noise, 3)) {
    EXPECT_EQ(process(estimator, frame), Estimator::Status::kInitialising);
  }
  EXPECT_TRUE(estimator.gyro_bias_known());
  EXPECT_LT((estimator.gyro_bias() - noise.gyro_bias).norm(), 1e-3);
  EXPECT_EQ(estimator.reason(), "standing still");
}

TEST(Estimator, NoisyFlightHoldsScaleAndItsKeyframesCarryFeatures) {
  const Trajectory trajectory = survey_flight(110, 2.6);
  SimulatedNoise noise{0.2, true, {0.004, -0.006, 0.003}, {0.03, -0.02, 0.02}};
  const Flown flown = fly(trajectory, simulate_frames(trajectory, 90, 2.0, noise, 4));
  ASSERT_GE(flown.started, 0);
  const Similarity fit = align_umeyama(flown.estimate, flown.truth, true);
  EXPECT_NEAR(fit.scale, 1.0, 0.03);
  EXPECT_LT(largest_error(flown), 5.0);  // of 230 m
  ASSERT_GT(flown.keyframes.size(), 20u);
  for (size_t k = 0; k < flown.keyframes.size(); ++k) {
    EXPECT_EQ(flown.keyframes[k].id, static_cast<int>(k));
    size_t good = 0;
    for (const KeyframeFeature& feature : flown.keyframes[k].features) good += feature.reprojection_error <= 8 ? 1 : 0;
    EXPECT_GT(good, 20u);
  }
}

// Normalised error squared per dimension of the motion between keyframes, from keyframe `first` on, over four flights:
// about one where the covariance is honest.
double nees_of_motion(double imu_times, size_t first) {
  const Trajectory trajectory = survey_flight(110, 2.6);
  double sum = 0;
  int count = 0;
  for (unsigned seed = 1; seed <= 4; ++seed) {
    SimulatedNoise noise{0.2, true, {0.004, -0.006, 0.003}, {0.03, -0.02, 0.02}, imu_times};
    const Flown flown = fly(trajectory, simulate_frames(trajectory, 60, 2.0, noise, seed));
    EXPECT_GT(flown.keyframes.size(), first + 10);
    for (size_t k = first; k < flown.keyframes.size(); ++k) {
      const Keyframe& a = flown.keyframes[k - 1];
      const Keyframe& b = flown.keyframes[k];
      const double t_a = 1e-6 * static_cast<double>(a.utime - 1'000'000'000);
      const double t_b = 1e-6 * static_cast<double>(b.utime - 1'000'000'000);
      const Eigen::Quaterniond q_a = trajectory.attitude(t_a), q_b = trajectory.attitude(t_b);
      const Vector3d p_true = q_a.conjugate() * (trajectory.position(t_b) - trajectory.position(t_a));
      const Vector3d p_est = a.state.q().conjugate() * (b.state.p() - a.state.p());
      Eigen::Matrix<double, 6, 1> error;
      error << p_est - p_true, so3_log((q_a.conjugate() * q_b).conjugate() * (a.state.q().conjugate() * b.state.q()));
      sum += error.dot(b.relative_covariance.ldlt().solve(error));
      count += 6;
    }
  }
  return sum / count;
}

// The published vertical is led after what is learnt of it: by turns that are told, so that whoever knew its error
// before goes on knowing it.
TEST(Estimator, TellsByWhatItHasLevelledThePublishedAttitude) {
  const Trajectory trajectory = survey_flight(110, 2.6);
  const Flown flown =
      fly(trajectory, simulate_frames(trajectory, 60, 2.0, {0.2, true, {0.004, -0.006, 0.003}, {0.15, -0.1, 0.02}}, 1));
  ASSERT_GT(flown.keyframes.size(), 20u);
  // In W: of the truth beyond the published attitude.
  const auto lean = [&](const Keyframe& keyframe) -> Eigen::Vector2d {
    const Eigen::Quaterniond q_W_B = trajectory.attitude(1e-6 * static_cast<double>(keyframe.utime - 1'000'000'000));
    const Eigen::Quaterniond q = q_W_B * keyframe.state.q().conjugate();
    const Eigen::Quaterniond turned = Eigen::AngleAxisd(-yaw_of(q), Vector3d::UnitZ()) * q;
    return so3_log(turned).head<2>();
  };
  const Keyframe& first = flown.keyframes.front();
  double moved = 0, untold = 0;
  for (const Keyframe& keyframe : flown.keyframes) {
    const Eigen::Vector2d change = lean(keyframe) - lean(first);
    moved = std::max(moved, change.norm());
    untold = std::max(untold, (change + keyframe.levelled - first.levelled).norm());
  }
  EXPECT_GT(moved, 0.005);
  EXPECT_LT(untold, 0.2 * moved);
}

TEST(Estimator, RelativeCovarianceIsHonest) {
  const double nees = nees_of_motion(1, 10);
  EXPECT_GT(nees, 0.2);
  EXPECT_LT(nees, 3.0);
  RecordProperty("normalised_error_squared", std::to_string(nees));
}

TEST(Estimator, RelativeCovarianceIsHonestThoughTheImuIsFiveTimesAsNoisyAsItsDataSheet) {
  const double nees = nees_of_motion(5, 40);
  EXPECT_GT(nees, 0.2);
  EXPECT_LT(nees, 3.0);
  RecordProperty("normalised_error_squared", std::to_string(nees));
}

// Flies until `until`, resets, and says how long the next session takes to start and how far its height is off.
struct Restarted {
  double took = -1, height_error = 0;
};
Restarted fly_and_reset(const Trajectory& trajectory, unsigned seed, double until, bool forgetful) {
  SimulatedNoise noise{0.2, true, {0.004, -0.006, 0.003}, {0.03, -0.02, 0.02}};
  Estimator estimator({}, downward_camera(), {}, test_camera().focal());
  const auto frames = simulate_frames(trajectory, until + 15, 1.0, noise, seed);
  bool ended = false;
  for (const SimulatedFrame& frame : frames) {
    if (!ended && frame.t > until) {
      EXPECT_EQ(estimator.status(), Estimator::Status::kTracking);
      ended = true;
      if (forgetful) {
        // Another process, without a memory.
        Estimator other({}, downward_camera(), {}, test_camera().focal());
        std::swap(estimator, other);
      } else {
        estimator.reset();
      }
    }
    const auto status = process(estimator, frame);
    if (!ended || status == Estimator::Status::kInitialising) continue;
    return {frame.t - until, estimator.height_above_ground() / trajectory.position(frame.t).z() - 1};
  }
  return {};
}

TEST(Estimator, RemembersTheHeightAndStartsAgainAtOnceAndAtTheRightScale) {
  const Trajectory trajectory = survey_flight(110, 2.6);
  double remembered = 0, forgotten = 0;
  for (unsigned seed = 1; seed <= 3; ++seed) {
    const Restarted next = fly_and_reset(trajectory, seed, 20, false);
    ASSERT_GE(next.took, 0);
    EXPECT_LT(next.took, 2.5) << seed;
    EXPECT_LT(std::abs(next.height_error), 0.06) << seed;
    remembered += next.took;
    forgotten += fly_and_reset(trajectory, seed, 20, true).took;
  }
  EXPECT_LT(remembered, forgotten - 1.0);
}

TEST(Estimator, DoubtsTheMemoryOfASessionThatFailedAndOfImpossibleNumbers) {
  const Trajectory trajectory = survey_flight(110, 2.6);
  auto frames = simulate_frames(trajectory, 25, 2.0, {}, 5);
  Estimator estimator({}, downward_camera(), {}, test_camera().focal());
  for (SimulatedFrame& frame : frames) {
    if (frame.t > 15) frame.features.clear();
    EXPECT_TRUE(estimator.memory() || frame.t < 12);
    if (process(estimator, frame) == Estimator::Status::kFailed) break;
  }
  estimator.reset();
  EXPECT_FALSE(estimator.memory());
  Memory memory;
  memory.height = 100;
  EXPECT_TRUE(estimator.resume(memory));
  for (const double height : {-1.0, 0.0, 1e6, std::nan("")}) {
    memory.height = height;
    EXPECT_FALSE(estimator.resume(memory)) << height;
  }
  memory.height = 100;
  memory.gyro_bias.x() = 3;
  EXPECT_FALSE(estimator.resume(memory));
  memory.gyro_bias.x() = 0;
  memory.utime = INT64_MIN;
  EXPECT_FALSE(estimator.resume(memory));
}

TEST(Estimator, LosingSightEndsTheSessionWithAReason) {
  const Trajectory trajectory = survey_flight(110, 2.6);
  auto frames = simulate_frames(trajectory, 25, 2.0, {}, 5);
  Estimator estimator({}, downward_camera(), {}, test_camera().focal());
  double failed_at = -1;
  for (SimulatedFrame& frame : frames) {
    if (frame.t > 15) frame.features.clear();
    if (process(estimator, frame) == Estimator::Status::kFailed) {
      failed_at = frame.t;
      break;
    }
  }
  ASSERT_GT(failed_at, 15);
  EXPECT_LT(failed_at, 17.5);
  EXPECT_NE(estimator.reason().find("landmarks in view"), std::string::npos);
}

}  // namespace
}  // namespace orthonav::vio
