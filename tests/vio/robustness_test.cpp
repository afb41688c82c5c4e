// Each promise of robustness, with an input that is broken in that way: features in, no images.
#include <cmath>
#include <functional>

#include <gtest/gtest.h>

#include "common/math/align.h"
#include "common/math/so3.h"
#include "common/math/statistics.h"
#include "services/vio/estimator.h"
#include "services/vio/scale_hint.h"
#include "tests/vio/simulated_flight.h"

namespace orthonav::vio {
namespace {

using Eigen::Vector3d;
using Status = Estimator::Status;

constexpr double kDegree = 3.14159265358979323846 / 180;
const SimulatedNoise kNoise{0.2, true, {0.004, -0.006, 0.003}, {0.03, -0.02, 0.02}};

struct Flown {
  std::vector<double> t;
  std::vector<Vector3d> estimate, truth;
  double failed_at = -1;  // s
  std::string reason;

  double largest_error(double from = 0) const {
    const Similarity fit = align_yaw_translation(estimate, truth);
    double largest = 0;
    for (size_t i = 0; i < t.size(); ++i) {
      if (t[i] >= from) largest = std::max(largest, (fit * estimate[i] - truth[i]).norm());
    }
    return largest;
  }
  // Largest distance from where the estimate was at `from`, until `to`.
  double drift(double from, double to) const {
    double largest = 0;
    const Vector3d* start = nullptr;
    for (size_t i = 0; i < t.size(); ++i) {
      if (t[i] < from || t[i] > to) continue;
      if (!start) start = &estimate[i];
      largest = std::max(largest, (estimate[i] - *start).norm());
    }
    return start ? largest : INFINITY;
  }
  double scale(double from, double to) const {
    std::vector<Vector3d> a, b;
    for (size_t i = 0; i < t.size(); ++i) {
      if (t[i] < from || t[i] > to) continue;
      a.push_back(estimate[i]);
      b.push_back(truth[i]);
    }
    return align_umeyama(a, b, true).scale;
  }
};

using Change = std::function<void(SimulatedFrame&)>;

Flown fly(
    Estimator& estimator, const Trajectory& trajectory, std::vector<SimulatedFrame> frames,
    const Change& change = [](SimulatedFrame&) {},
    const std::function<std::optional<HeightMeasurement>(double)>& height = {}) {
  Flown flown;
  for (SimulatedFrame& frame : frames) {
    change(frame);
    const auto measured = height ? height(frame.t) : std::nullopt;
    const auto status = process(estimator, frame, measured);
    if (status == Status::kFailed) {
      flown.failed_at = frame.t;
      flown.reason = estimator.reason();
      break;
    }
    if (status == Status::kInitialising) continue;
    if (estimator.rescaled()) {
      flown.t.clear();
      flown.estimate.clear();
      flown.truth.clear();
    }
    flown.t.push_back(frame.t);
    flown.estimate.emplace_back(estimator.newest().p());
    flown.truth.push_back(trajectory.position(frame.t));
  }
  return flown;
}

Estimator make(const EstimatorOptions& options = {}, const Extrinsics& extrinsics = downward_camera()) {
  return Estimator(options, extrinsics, {}, test_camera().focal());
}

TEST(Robustness, StandingStillInARoomDoesNotDrift) {
  const Trajectory flight = with_pause(survey_flight(2, 0.4), 12, 75, 0);
  auto estimator = make();
  const Flown flown = fly(estimator, flight, simulate_frames(flight, 80, 0.3, kNoise, 1));
  ASSERT_LT(flown.failed_at, 0) << flown.reason;
  EXPECT_LT(flown.drift(14.5, 74.5), 0.1);
  EXPECT_LT(flown.largest_error(), 0.25);
}

TEST(Robustness, HoveringAt110MetresDoesNotDrift) {
  const Trajectory flight = with_pause(survey_flight(110, 2.6), 20, 85, 0.4);
  auto estimator = make();
  const Flown flown = fly(estimator, flight, simulate_frames(flight, 82, 1.0, kNoise, 2));
  ASSERT_LT(flown.failed_at, 0) << flown.reason;
  // The error, not the way: the aircraft itself wanders by half a metre.
  std::vector<Vector3d> estimate, truth;
  for (size_t i = 0; i < flown.t.size(); ++i) {
    if (flown.t[i] < 22) continue;
    estimate.push_back(flown.estimate[i]);
    truth.push_back(flown.truth[i]);
  }
  ASSERT_GT(estimate.size(), 590u);
  const Similarity fit = align_yaw_translation(flown.estimate, flown.truth);
  const Vector3d first = fit * estimate[0] - truth[0];
  for (size_t i = 0; i < truth.size(); ++i) EXPECT_LT((fit * estimate[i] - truth[i] - first).norm(), 1.0) << i;
}

// What the estimator makes of a camera whose stamps are off by `time_offset`, s.
double time_offset_found(double time_offset, unsigned seed) {
  const Trajectory flight = survey_flight(30, 3);
  SimulatedCamera camera;
  camera.time_offset = time_offset;
  auto frames = simulate_frames(flight, 40, 1.0, {0.2}, seed, camera);
  auto estimator = make();
  double last = 0;
  const Flown flown = fly(estimator, flight, frames, [&](SimulatedFrame& frame) {
    // As Vio does: samples between the states' times.
    const double now = frame.t + estimator.time_offset();
    if (frame.t > 0) frame.imu = ideal_imu(flight, last, now);
    last = now;
  });
  EXPECT_LT(flown.failed_at, 0) << flown.reason;
  return estimator.time_offset();
}

TEST(Robustness, FindsTheTimeOffsetBetweenCameraAndImu) {
  for (unsigned seed = 3; seed < 8; ++seed) EXPECT_NEAR(time_offset_found(0.012, seed), 0.012, 0.006) << seed;
}

TEST(Robustness, FindsNoTimeOffsetWhereThereIsNone) {
  for (unsigned seed = 3; seed < 8; ++seed) EXPECT_NEAR(time_offset_found(0, seed), 0, 0.006) << seed;
}

TEST(Robustness, TheTimeOffsetStaysWithinItsBounds) {
  const Trajectory flight = survey_flight(30, 3);
  SimulatedCamera camera;
  camera.time_offset = 0.15;
  EstimatorOptions options;
  options.max_time_offset = 0.03;
  options.time_offset_sigma = 0.05;
  auto estimator = make(options);
  double last = 0;
  fly(estimator, flight, simulate_frames(flight, 25, 1.0, {0.2}, 3, camera), [&](SimulatedFrame& frame) {
    EXPECT_LE(std::abs(estimator.time_offset()), 0.03);
    const double now = frame.t + estimator.time_offset();
    if (frame.t > 0) frame.imu = ideal_imu(flight, last, now);
    last = now;
  });
}

TEST(Robustness, RefinesTheExtrinsicsOnRequest) {
  const Trajectory flight = survey_flight(30, 3);
  const auto frames = simulate_frames(flight, 40, 1.0, kNoise, 4);
  Extrinsics believed = downward_camera();
  believed.R_B_C *= so3_exp(Vector3d(0.6, -0.5, 0.6) * kDegree).toRotationMatrix();
  EstimatorOptions options;
  options.refine_extrinsics = true;
  options.extrinsics_sigma_deg = 1;
  auto estimator = make(options, believed);
  const Flown flown = fly(estimator, flight, frames);
  ASSERT_LT(flown.failed_at, 0) << flown.reason;
  const Eigen::Matrix3d left = downward_camera().R_B_C.transpose() * estimator.extrinsics().R_B_C;
  EXPECT_LT(so3_log(Eigen::Quaterniond(left)).norm(), 0.25 * kDegree);  // of one degree
}

TEST(Robustness, AcceptsARollingShutterWhenToldItsReadoutTime) {
  const Trajectory flight = survey_flight(30, 3);
  constexpr double kReadout = 0.03;
  const auto error = [&](double readout_time, double told) {
    SimulatedCamera camera;
    camera.readout_time = readout_time;
    auto estimator = make();
    const auto frames = simulate_frames(flight, 30, 1.0, {0.1}, 5, camera);
    const Flown flown = fly(estimator, flight, frames, [&](SimulatedFrame& frame) {
      for (TrackedFeature& feature : frame.features) feature.row_delay = told * (feature.pixel.y() / 479 - 0.5);
    });
    return flown.t.empty() ? INFINITY : flown.largest_error();
  };
  const double global = error(0, 0), untold = error(kReadout, 0), told = error(kReadout, kReadout);
  EXPECT_LT(told - global, 0.5 * (untold - global)) << global << " " << told << " " << untold;
}

// A straight leg at constant speed: nothing in the images and the IMU holds the scale there.
Trajectory long_leg() {
  const Trajectory sway = survey_flight(110, 3);
  Trajectory leg = sway;
  leg.position = [=](double t) {
    const double fade = t < 15 ? 1.0 : std::exp(-(t - 15) * (t - 15) / 8);
    const Vector3d p = sway.position(t);
    const Vector3d straight(3 * t, 0, 110);
    return Vector3d(straight + fade * (p - straight));
  };
  leg.orientation = [=](double t) {
    return Vector3d((t < 15 ? 1.0 : std::exp(-(t - 15) * (t - 15) / 8)) * sway.orientation(t));
  };
  return leg;
}

TEST(Robustness, MeasuredHeightsHoldTheScaleDespiteTheirBias) {
  const Trajectory leg = long_leg();
  const auto frames = simulate_frames(leg, 55, 1.0, kNoise, 6);
  auto without = make(), with = make();
  const Flown free = fly(without, leg, frames);
  const Flown aided = fly(
      with, leg, frames, [](SimulatedFrame&) {},
      [&](double t) {
        return HeightMeasurement{leg.position(t).z() + 1.0, 0.5};
      });
  ASSERT_LT(aided.failed_at, 0) << aided.reason;
  EXPECT_LT(std::abs(aided.scale(30, 55) - 1), 0.02);
  EXPECT_LT(std::abs(aided.scale(30, 55) - 1), std::max(0.01, std::abs(free.scale(30, 55) - 1)));
}

TEST(Robustness, AScaleHintMovesTheScale) {
  const Trajectory leg = long_leg();
  const auto frames = simulate_frames(leg, 40, 1.0, kNoise, 6);
  auto without = make(), with = make();
  const Flown free = fly(without, leg, frames);
  const Flown hinted = fly(with, leg, frames, [&](SimulatedFrame& frame) {
    if (std::abs(frame.t - 25) < 1e-6) with.hint_scale(1.05, 0.002);
  });
  // The hint is wrong on purpose: what follows it has been lengthened.
  EXPECT_NEAR(free.scale(30, 40) / hinted.scale(30, 40), 1.05, 0.02);
}

TEST(ScaleHinter, ComparesTheSameWay) {
  ScaleHinter hinter(100);
  std::optional<ScaleHint> hint;
  for (int k = 0; k <= 30; ++k) {
    hinter.add_odometry(k, 7, Vector3d(0, 4.0 * k, 0));
    hint = hinter.add_fused(k, 7, true, 1, Vector3d(5.0 * k, 0, 3), 2.0);
    EXPECT_EQ(hint.has_value(), k == 20) << k;
    if (hint) {
      EXPECT_NEAR(hint->ratio, 1.25, 1e-12);
      EXPECT_NEAR(hint->stddev, std::hypot(2.0, 2.0) / 80, 1e-12);
    }
  }
  // A jump of the fused position begins a new stretch, and so does a new session.
  hinter.add_odometry(31, 7, Vector3d(0, 200, 0));
  EXPECT_FALSE(hinter.add_fused(31, 7, true, 2, Vector3d(900, 0, 3), 2.0));
  hinter.add_odometry(32, 8, Vector3d(0, 0, 0));
  EXPECT_FALSE(hinter.add_fused(32, 8, true, 2, Vector3d(1900, 0, 3), 2.0));
}

TEST(Robustness, SurvivesASaturatedGyroscopeThatSaysSo) {
  const Trajectory flight = survey_flight(30, 3);
  const auto frames = simulate_frames(flight, 30, 1.0, kNoise, 8);
  auto estimator = make();
  const Flown flown = fly(estimator, flight, frames, [](SimulatedFrame& frame) {
    if (frame.t < 18 || frame.t > 18.45) return;
    for (ImuSample& sample : frame.imu) {
      sample.gyro = sample.gyro.cwiseMin(0.01).cwiseMax(-0.01);
      sample.accel = sample.accel.cwiseMin(9.0).cwiseMax(-9.0);
      sample.saturated = true;
    }
  });
  ASSERT_LT(flown.failed_at, 0) << flown.reason;
  EXPECT_LT(flown.largest_error(), 1.0);
}

TEST(Robustness, SurvivesAGapInTheImu) {
  const Trajectory flight = survey_flight(30, 3);
  const auto frames = simulate_frames(flight, 30, 1.0, kNoise, 9);
  auto estimator = make();
  const Flown flown = fly(estimator, flight, frames, [](SimulatedFrame& frame) {
    // Each of these intervals is only known at its ends: gaps of 0.1 s, four in a row.
    if (frame.t > 17.95 && frame.t < 18.35) frame.imu = {frame.imu.front(), frame.imu.back()};
  });
  ASSERT_LT(flown.failed_at, 0) << flown.reason;
  EXPECT_LT(flown.largest_error(), 1.0);
}

TEST(Robustness, ThirtyPercentWrongTracksAreOutvoted) {
  const Trajectory flight = survey_flight(110, 2.6);
  auto frames = simulate_frames(flight, 40, 0.0, kNoise, 10);
  auto estimator = make();
  // Cars and shadows: a third of the features move on by themselves, each in its own direction. (At a start it is the
  // front end's test that finds them.)
  const Flown flown = fly(estimator, flight, frames, [](SimulatedFrame& frame) {
    std::vector<TrackedFeature> moved;
    for (TrackedFeature& feature : frame.features) {
      if (feature.id % 10 < 3 && frame.t > 15) {
        const double turn = static_cast<double>(feature.id);
        feature.pixel += 12 * (frame.t - 15) * Eigen::Vector2d(std::cos(turn), std::sin(turn));
        const auto ray = test_camera().unproject(feature.pixel);
        if (!ray || !test_camera().contains(feature.pixel)) continue;
        feature.ray = *ray;
      }
      moved.push_back(feature);
    }
    frame.features = moved;
  });
  ASSERT_LT(flown.failed_at, 0) << flown.reason;
  ASSERT_GT(flown.t.size(), 200u);
  EXPECT_LT(flown.largest_error(), 4.0);  // of 100 m
}

TEST(Robustness, ContradictionBetweenCameraAndImuEndsTheSessionWithinTwoSeconds) {
  const Trajectory flight = survey_flight(110, 2.6);
  const auto frames = simulate_frames(flight, 30, 1.0, kNoise, 11);
  const std::vector<Change> breaks = {
      [](SimulatedFrame& frame) {  // the gyroscope comes loose
        for (ImuSample& sample : frame.imu) sample.gyro += Vector3d(0.4, 0.2, -0.3);
      },
      [](SimulatedFrame& frame) {  // the accelerometer's scale breaks
        for (ImuSample& sample : frame.imu) sample.accel *= 1.5;
      },
      [](SimulatedFrame& frame) {  // pictures of something else
        for (TrackedFeature& feature : frame.features) {
          feature.ray.head<2>() += 0.1 * (frame.t - 20) *
                                   Eigen::Vector2d(std::sin(37.0 * static_cast<double>(feature.id)),
                                                   std::cos(91.0 * static_cast<double>(feature.id)));
        }
      },
  };
  for (size_t k = 0; k < breaks.size(); ++k) {
    auto estimator = make();
    const Flown flown = fly(estimator, flight, frames, [&](SimulatedFrame& frame) {
      if (frame.t > 20) breaks[k](frame);
    });
    EXPECT_GT(flown.failed_at, 20) << k;
    EXPECT_LE(flown.failed_at, 22.1) << k << ": " << flown.reason;
    EXPECT_FALSE(flown.reason.empty()) << k;
  }
}

// An accelerometer far worse than configured makes the start's scale wrong. It is found, and published anew.
TEST(Robustness, AWrongStartIsFound) {
  const Trajectory flight = survey_flight(110, 2.6);
  SimulatedNoise noise = kNoise;
  noise.accel_bias = {0.35, -0.3, 0.1};
  int wrong = 0;
  for (unsigned seed = 1; seed <= 3; ++seed) {
    EstimatorOptions options;
    options.init_scale_sigma = 0.3;  // starts that nobody should trust
    auto estimator = make(options);
    const auto frames = simulate_frames(flight, 28, 1.0, noise, seed);
    double first = 0;
    int rescaled = 0;
    const Flown flown = fly(estimator, flight, frames, [&](SimulatedFrame&) {
      if (first == 0 && estimator.last_keyframe_id() >= 0) first = estimator.height_above_ground() / 110;
      rescaled += estimator.rescaled() ? 1 : 0;
    });
    if (first == 0 || std::abs(first - 1) < 0.25) continue;  // this one was right
    ++wrong;
    EXPECT_TRUE(rescaled > 0 || flown.failed_at > 0) << "seed " << seed << " started at " << first;
  }
  EXPECT_GT(wrong, 0) << "the starts have become better than this test";
}

}  // namespace
}  // namespace orthonav::vio
