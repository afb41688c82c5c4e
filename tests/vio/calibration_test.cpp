// A calibration that is wrong is named within ten seconds of motion, and one that is right never is.
#include <cmath>
#include <functional>

#include <gtest/gtest.h>

#include "common/math/so3.h"
#include "services/vio/calibration_check.h"
#include "tests/vio/simulated_flight.h"

namespace orthonav::vio {
namespace {

using Eigen::Vector3d;

constexpr double kDegree = 3.14159265358979323846 / 180;
const SimulatedNoise kNoise{0.2, true, {0.006, -0.008, 0.005}, {0.05, -0.04, 0.03}};

struct Verdict {
  double at = -1;  // s; -1: never
  std::string complaint;
};

Verdict judge(const std::vector<SimulatedFrame>& frames, const Extrinsics& extrinsics,
              const std::function<void(ImuSample&)>& change) {
  CalibrationCheck check({}, extrinsics, 9.81, test_camera().focal());
  for (const SimulatedFrame& frame : frames) {
    auto imu = frame.imu;
    for (ImuSample& sample : imu) change(sample);
    check.add(frame.features, imu);
    if (!check.complaint().empty()) return {frame.t, check.complaint()};
  }
  return {};
}

const std::vector<SimulatedFrame>& flight_over_flat_ground() {
  static const auto frames = simulate_frames(survey_flight(110, 2.6), 60, 0.0, kNoise, 7);
  return frames;
}

const std::vector<SimulatedFrame>& flight_in_a_room() {
  static const auto frames = simulate_frames(survey_flight(2, 0.4), 60, 0.3, kNoise, 8);
  return frames;
}

TEST(CalibrationCheck, SaysNothingOfARightCalibration) {
  for (const auto* frames : {&flight_over_flat_ground(), &flight_in_a_room()}) {
    const Verdict verdict = judge(*frames, downward_camera(), [](ImuSample&) {});
    EXPECT_EQ(verdict.complaint, "") << "after " << verdict.at << " s";
  }
}

TEST(CalibrationCheck, SaysNothingOfAnAirframeThatShakes) {
  // 37 and 61 Hz, 5 m/s^2 and 0.1 rad/s an axis: the mean of what single samples measure is a quarter too much.
  const Verdict verdict = judge(flight_over_flat_ground(), downward_camera(), [](ImuSample& sample) {
    const double t = 1e-6 * static_cast<double>(sample.utime % 1'000'000'000);
    for (int axis = 0; axis < 3; ++axis) {
      const double tones = std::sin(2 * M_PI * 37 * t + axis) + std::sin(2 * M_PI * 61 * t + 2 * axis);
      sample.accel[axis] += 5 * tones;
      sample.gyro[axis] += 0.1 * tones;
    }
  });
  EXPECT_EQ(verdict.complaint, "") << "after " << verdict.at << " s";
}

TEST(CalibrationCheck, NamesACameraRotationWrongByFiveDegrees) {
  for (const auto* frames : {&flight_over_flat_ground(), &flight_in_a_room()}) {
    for (int axis = 0; axis < 3; ++axis) {
      Extrinsics wrong = downward_camera();
      wrong.R_B_C *= so3_exp(5 * kDegree * Vector3d::Unit(axis)).toRotationMatrix();
      const Verdict verdict = judge(*frames, wrong, [](ImuSample&) {});
      EXPECT_GE(verdict.at, 0) << axis;
      EXPECT_LE(verdict.at, 10) << axis;
      EXPECT_NE(verdict.complaint.find("camera-IMU rotation"), std::string::npos) << verdict.complaint;
    }
  }
}

TEST(CalibrationCheck, NamesUnits) {
  const auto& frames = flight_over_flat_ground();
  Verdict verdict = judge(frames, downward_camera(), [](ImuSample& sample) { sample.gyro /= kDegree; });
  EXPECT_NE(verdict.complaint.find("units"), std::string::npos) << verdict.complaint;
  EXPECT_LE(verdict.at, 10);
  verdict = judge(frames, downward_camera(), [](ImuSample& sample) { sample.gyro *= kDegree; });
  EXPECT_NE(verdict.complaint.find("units"), std::string::npos) << verdict.complaint;
  EXPECT_LE(verdict.at, 10);
  verdict = judge(frames, downward_camera(), [](ImuSample& sample) { sample.accel /= 9.81; });
  EXPECT_NE(verdict.complaint.find("accelerometer"), std::string::npos) << verdict.complaint;
  EXPECT_LE(verdict.at, 10);
}

TEST(CalibrationCheck, NamesAxes) {
  const auto& frames = flight_over_flat_ground();
  const std::vector<std::function<void(ImuSample&)>> mistakes = {
      [](ImuSample& sample) { sample.gyro = Vector3d(sample.gyro.y(), -sample.gyro.x(), sample.gyro.z()); },
      [](ImuSample& sample) { sample.gyro.x() *= -1; },
      [](ImuSample& sample) { sample.gyro = Vector3d(sample.gyro.z(), sample.gyro.x(), sample.gyro.y()); },
  };
  for (size_t k = 0; k < mistakes.size(); ++k) {
    const Verdict verdict = judge(frames, downward_camera(), mistakes[k]);
    EXPECT_GE(verdict.at, 0) << k;
    EXPECT_LE(verdict.at, 10) << k;
    EXPECT_TRUE(verdict.complaint.find("axes") != std::string::npos ||
                verdict.complaint.find("gyroscope") != std::string::npos)
        << verdict.complaint;
  }
}

TEST(RelativeRotation, IsFoundOnAPlane) {
  const auto frames = simulate_frames(survey_flight(110, 2.6), 10, 0.0, {0.2}, 3);
  const Trajectory flight = survey_flight(110, 2.6);
  const Eigen::Matrix3d R_B_C = downward_camera().R_B_C;
  for (size_t k = 30; k + 5 < frames.size(); k += 7) {
    std::vector<Vector3d> rays_1, rays_2;
    for (const TrackedFeature& a : frames[k].features) {
      for (const TrackedFeature& b : frames[k + 5].features) {
        if (a.id != b.id) continue;
        rays_1.push_back(a.ray);
        rays_2.push_back(b.ray);
      }
    }
    ASSERT_GT(rays_1.size(), 50u);
    const Eigen::Matrix3d R = (flight.attitude(frames[k + 5].t).toRotationMatrix() * R_B_C).transpose() *
                              flight.attitude(frames[k].t).toRotationMatrix() * R_B_C;
    const Vector3d near(0.004, -0.004, 0.01);  // a gyroscope with a bias
    const RelativeRotation found = relative_rotation(rays_1, rays_2, so3_log(Eigen::Quaterniond(R)) + near, 850, 0.3);
    const Eigen::Matrix3d difference = so3_exp(found.w).toRotationMatrix() * R.transpose();
    const Vector3d error = so3_log(Eigen::Quaterniond(difference));
    EXPECT_LT(error.dot(found.information * error), 25) << k;  // five standard deviations in all
    EXPECT_LT(std::abs(error.z()), 2e-3) << k;
  }
}

}  // namespace
}  // namespace orthonav::vio
