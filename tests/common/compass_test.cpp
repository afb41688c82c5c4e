#include <cmath>
#include <fstream>
#include <random>

#include <Eigen/Geometry>
#include <gtest/gtest.h>

#include "common/compass/level.h"
#include "common/compass/magnetic_calibration.h"
#include "common/math/angles.h"
#include "common/math/so3.h"
#include "tests/support/temporary_folder.h"

namespace orthonav {
namespace {

// Central Europe: 20 uT to magnetic north, 44 uT down.
const Eigen::Vector3d kField_M(0, 20e-6, -44e-6);  // east, magnetic north, up

struct Turn {
  std::vector<Eigen::Vector3d> readings, ups;
  std::vector<double> headings;
};

// Attitudes by heading (clockwise) and tilt, read by a magnetometer with iron and white noise.
Turn fly(double tilt, const Eigen::Vector3d& hard, const Eigen::Matrix3d& distortion, double noise, double part = 1) {
  Turn turn;
  std::mt19937 random(3);
  std::normal_distribution<double> gauss(0, noise);
  for (int i = 0; i < 720; ++i) {
    const double heading = part * 2 * M_PI * i / 720;
    const double roll = tilt * std::sin(13.0 * i), pitch = tilt * std::cos(7.0 * i);
    const Eigen::Quaterniond q_M_B(Eigen::AngleAxisd(M_PI / 2 - heading, Eigen::Vector3d::UnitZ()) *
                                   Eigen::AngleAxisd(pitch, Eigen::Vector3d::UnitY()) *
                                   Eigen::AngleAxisd(roll, Eigen::Vector3d::UnitX()));
    const Eigen::Vector3d field_B = q_M_B.conjugate() * kField_M;
    turn.readings.push_back(distortion * field_B + hard + Eigen::Vector3d(gauss(random), gauss(random), gauss(random)));
    turn.ups.push_back(q_M_B.conjugate() * Eigen::Vector3d::UnitZ());
    turn.headings.push_back(heading_of(q_M_B));
  }
  return turn;
}

double worst_heading_error(const Turn& turn, const MagneticCalibration& calibration) {
  double worst = 0;
  for (size_t i = 0; i < turn.readings.size(); ++i) {
    const double heading = magnetic_heading(calibration.correct(turn.readings[i]), turn.ups[i]);
    worst = std::max(worst, std::abs(wrap_angle(heading - turn.headings[i])));
  }
  return worst;
}

Eigen::Matrix3d soft() {
  Eigen::Matrix3d m;
  m << 1.12, 0.05, 0, 0.05, 0.91, 0, 0, 0, 1;
  return m;
}

TEST(Compass, HeadingIsThatOfTheAttitudeAtAnyTilt) {
  const Turn turn = fly(0.5, Eigen::Vector3d::Zero(), Eigen::Matrix3d::Identity(), 0);
  EXPECT_LT(worst_heading_error(turn, {}), 1e-9);
}

TEST(Compass, ALevelTurnTakesOutTheHorizontalIron) {
  const Eigen::Vector3d hard(9e-6, -6e-6, 0);
  const Turn turn = fly(0.0, hard, soft(), 0);
  EXPECT_GT(worst_heading_error(turn, {}), 20 * kDegree);
  const CalibrationFit fit = fit_calibration(turn.readings, turn.ups);
  EXPECT_FALSE(fit.full);
  EXPECT_LT((fit.calibration.hard_iron - hard).norm(), 1e-10);
  EXPECT_LT(worst_heading_error(turn, fit.calibration), 1e-6);
}

TEST(Compass, TumblingTakesOutTheIronOfAllAxesUnderNoise) {
  const Eigen::Vector3d hard(9e-6, -6e-6, 12e-6);
  Eigen::Matrix3d distortion = soft();
  distortion(2, 2) = 0.93;
  distortion(0, 2) = distortion(2, 0) = -0.03;
  const Turn turn = fly(1.2, hard, distortion, 0.2e-6);
  const CalibrationFit fit = fit_calibration(turn.readings, turn.ups);
  EXPECT_TRUE(fit.full);
  EXPECT_LT((fit.calibration.hard_iron - hard).norm(), 0.1e-6);
  const Turn clean = fly(0.3, hard, distortion, 0);
  EXPECT_LT(worst_heading_error(clean, fit.calibration), 1.0 * kDegree);
  // 0.2 uT of 48 uT.
  EXPECT_NEAR(fit.residual, 0.2 / 48.3, 0.001);
}

TEST(Compass, HalfATurnOrASilentSensorIsRefused) {
  const Turn half = fly(0.0, Eigen::Vector3d::Zero(), soft(), 0.05e-6, 0.5);
  EXPECT_THROW(fit_calibration(half.readings, half.ups), std::runtime_error);
  const std::vector<Eigen::Vector3d> still(100, Eigen::Vector3d(1e-6, 2e-6, 3e-6)), up(100, Eigen::Vector3d::UnitZ());
  EXPECT_THROW(fit_calibration(still, up), std::runtime_error);
  EXPECT_THROW(fit_calibration({}, {}), std::runtime_error);
}

TEST(Compass, TheWrittenCalibrationReadsBack) {
  const test::TemporaryFolder folder;
  MagneticCalibration written;
  written.hard_iron = {9e-6, -6e-6, 12e-6};
  written.soft_iron = soft();
  written.heading_stddev = 3 * kDegree;
  std::ofstream(folder / "compass.yaml") << written.to_yaml("a test");
  const MagneticCalibration read = MagneticCalibration::load(folder / "compass.yaml");
  EXPECT_LT((read.hard_iron - written.hard_iron).norm(), 1e-11);
  EXPECT_LT((read.soft_iron - written.soft_iron).norm(), 1e-6);
  EXPECT_NEAR(read.heading_stddev, written.heading_stddev, 1e-4);
}

TEST(Level, FollowsTheGyroscopeThroughAHorizontalAcceleration) {
  Level level;
  // Level for 1 s, then rolled by 20 degrees within 1 s while the accelerometer is shaken: only the gyroscope tells.
  const double rate = 20 * kDegree;
  int64_t utime = 0;
  for (int i = 0; i < 200; ++i) level.feed(utime += 5000, Eigen::Vector3d::Zero(), {0, 0, 9.81});
  for (int i = 0; i < 200; ++i) level.feed(utime += 5000, {rate, 0, 0}, {8, 0, 9.81});
  const Eigen::Vector3d expected(0, std::sin(20 * kDegree), std::cos(20 * kDegree));
  EXPECT_LT((*level.up_B() - expected).norm(), 1e-6);
  // Held there, a wrong start is forgotten.
  Level wrong;
  wrong.feed(1, Eigen::Vector3d::Zero(), {9.81, 0, 0});
  for (int i = 1; i < 6000; ++i) wrong.feed(1 + i * 5000, Eigen::Vector3d::Zero(), {0, 0, 9.81});
  EXPECT_LT((*wrong.up_B() - Eigen::Vector3d::UnitZ()).norm(), 0.01);
}

}  // namespace
}  // namespace orthonav
