#include "tools/simulate/sensors.h"

#include <algorithm>
#include <numbers>
#include <utility>

#include <Eigen/QR>
#include <gtest/gtest.h>

#include "common/math/angles.h"
#include "common/math/so3.h"
#include "tests/simulate/flight_fixtures.h"
#include "tools/simulate/flight_plan.h"

namespace orthonav::simulate {
namespace {

constexpr int64_t kStart = 1700000000000000;

const Trajectory& flight() {
  static const Trajectory trajectory = plan_flight(FlightOptions(), flat_area(510, 400), 9.81, 1);
  return trajectory;
}

SensorSurroundings surroundings(double declination = 0.1) {
  return {EnuFrame({47.4, 8.5, 500.0}), [](const Eigen::Vector2d&) { return 2.0; },
          [](const Eigen::Vector2d& p) { return Eigen::Vector2d(0.5, 1e-3 * p.y()); }, declination, kStart};
}

// All levels zero.
SensorOptions silent() {
  SensorOptions o;
  o.imu = {0, 0, 0, 0, 0, 0};
  o.camera.time_jitter_ms = 0;
  o.compass.bias_deg = o.compass.noise_deg = 0;
  o.altitude.bias_m = o.altitude.noise_m = 0;
  o.gnss.cep_m = 0;
  return o;
}

SensorRecord record(const SensorOptions& options, double seconds, uint64_t seed = 1, double imu_rate = 200) {
  return simulate_sensors(flight(), seconds, imu_rate, options, surroundings(), seed);
}

double seconds_of(int64_t utime) {
  return static_cast<double>(utime - kStart) * 1e-6;
}

double stddev(const std::vector<double>& values) {
  double square = 0;
  for (const double v : values) square += v * v;
  return std::sqrt(square / static_cast<double>(values.size()));
}

TEST(Sensors, WithoutNoiseTheInertialSensorIsExact) {
  const SensorRecord r = record(silent(), 20);
  ASSERT_EQ(r.imu.size(), 4001U);
  for (const imu_t& imu : r.imu) {
    const MotionState state = flight().at(seconds_of(imu.utime));
    EXPECT_EQ((Eigen::Map<const Eigen::Vector3d>(imu.angular_rate)), state.angular_rate);
    EXPECT_EQ((Eigen::Map<const Eigen::Vector3d>(imu.specific_force)), state.specific_force);
  }
}

// Differences of a sequence of bias plus white noise, averaged over `window` samples, as Allan's variance takes them.
double allan_deviation(const std::vector<double>& samples, size_t window) {
  std::vector<double> means;
  for (size_t i = 0; i + window <= samples.size(); i += window) {
    double sum = 0;
    for (size_t k = 0; k < window; ++k) sum += samples[i + k];
    means.push_back(sum / static_cast<double>(window));
  }
  double square = 0;
  for (size_t i = 1; i < means.size(); ++i) square += (means[i] - means[i - 1]) * (means[i] - means[i - 1]);
  return std::sqrt(0.5 * square / static_cast<double>(means.size() - 1));
}

TEST(Sensors, NoiseDensitiesAreAsConfigured) {
  SensorOptions white = silent(), walk = silent();
  white.imu.gyro_noise = 1.7e-4;
  white.imu.accel_noise = 2.0e-3;
  walk.imu.gyro_walk = 1.9e-5;
  walk.imu.accel_walk = 3.0e-3;
  const double seconds = 440;
  const SensorRecord exact = record(silent(), seconds), noisy = record(white, seconds),
                     drifting = record(walk, seconds);
  for (int axis = 0; axis < 3; ++axis) {
    std::vector<double> gyro, accel, gyro_drift, accel_drift;
    for (size_t i = 0; i < exact.imu.size(); ++i) {
      gyro.push_back(noisy.imu[i].angular_rate[axis] - exact.imu[i].angular_rate[axis]);
      accel.push_back(noisy.imu[i].specific_force[axis] - exact.imu[i].specific_force[axis]);
      gyro_drift.push_back(drifting.imu[i].angular_rate[axis] - exact.imu[i].angular_rate[axis]);
      accel_drift.push_back(drifting.imu[i].specific_force[axis] - exact.imu[i].specific_force[axis]);
    }
    // White noise of density N averaged over tau: N / sqrt(tau). Here tau = 0.1 s, some 2000 differences.
    EXPECT_NEAR(allan_deviation(gyro, 20), 1.7e-4 / std::sqrt(0.1), 0.06 * 1.7e-4 / std::sqrt(0.1));
    EXPECT_NEAR(allan_deviation(accel, 20), 2.0e-3 / std::sqrt(0.1), 0.06 * 2.0e-3 / std::sqrt(0.1));
    // A random walk of density K: K sqrt(tau / 3). Here tau = 1 s, 440 differences.
    EXPECT_NEAR(allan_deviation(gyro_drift, 200), 1.9e-5 / std::sqrt(3.0), 0.15 * 1.9e-5 / std::sqrt(3.0));
    EXPECT_NEAR(allan_deviation(accel_drift, 200), 3.0e-3 / std::sqrt(3.0), 0.15 * 3.0e-3 / std::sqrt(3.0));
  }
}

TEST(Sensors, TurnOnBiasesAreDrawnPerFlight) {
  SensorOptions options = silent();
  options.imu.gyro_turn_on = 0.01;
  options.imu.accel_turn_on = 0.05;
  std::vector<double> gyro, accel;
  for (uint64_t seed = 0; seed < 200; ++seed) {
    const truth_t truth = record(options, 0.1, seed).truth.back();
    for (int axis = 0; axis < 3; ++axis) {
      gyro.push_back(truth.gyro_bias[axis]);
      accel.push_back(truth.accel_bias[axis]);
    }
  }
  EXPECT_NEAR(stddev(gyro), 0.01, 0.0012);
  EXPECT_NEAR(stddev(accel), 0.05, 0.006);
}

// The matrix M and residual of M input = output, by least squares.
std::pair<Eigen::MatrixXd, double> linear_map(const Eigen::MatrixXd& input, const Eigen::MatrixXd& output) {
  const Eigen::MatrixXd solved = input.transpose().colPivHouseholderQr().solve(output.transpose()).transpose();
  return {solved, (solved * input - output).cwiseAbs().maxCoeff()};
}

// What a sensor said less the truth, and what it may have felt: rate and force, three rows each.
struct Felt {
  Eigen::MatrixXd gyro_error, accel_error, rate, force;
};
Felt felt(const SensorOptions& options, uint64_t seed) {
  const SensorRecord r = record(options, 20, seed);
  const auto n = static_cast<Eigen::Index>(r.imu.size());
  Felt all{Eigen::MatrixXd(3, n), Eigen::MatrixXd(3, n), Eigen::MatrixXd(3, n), Eigen::MatrixXd(3, n)};
  for (Eigen::Index i = 0; i < n; ++i) {
    const imu_t& imu = r.imu[static_cast<size_t>(i)];
    const MotionState state = flight().at(seconds_of(imu.utime));
    all.rate.col(i) = state.angular_rate;
    all.force.col(i) = state.specific_force;
    all.gyro_error.col(i) = Eigen::Map<const Eigen::Vector3d>(imu.angular_rate) - state.angular_rate;
    all.accel_error.col(i) = Eigen::Map<const Eigen::Vector3d>(imu.specific_force) - state.specific_force;
  }
  return all;
}

TEST(Sensors, ScaleFactorsAndLeaningAxesAreOneMatrixPerFlight) {
  SensorOptions options = silent();
  options.imu.gyro_scale = 0.01;
  options.imu.gyro_misalignment_deg = 0.5;
  options.imu.accel_scale = 0.02;
  options.imu.accel_misalignment_deg = 1.0;
  std::vector<double> diagonal, beside, accel_diagonal, accel_beside;
  for (uint64_t seed = 0; seed < 30; ++seed) {
    const Felt all = felt(options, seed);
    const auto [gyro, gyro_residual] = linear_map(all.rate, all.gyro_error);
    const auto [accel, accel_residual] = linear_map(all.force, all.accel_error);
    EXPECT_LT(gyro_residual, 1e-9);
    EXPECT_LT(accel_residual, 1e-9);
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) {
        (i == j ? diagonal : beside).push_back(gyro(i, j));
        (i == j ? accel_diagonal : accel_beside).push_back(accel(i, j));
      }
    }
  }
  EXPECT_NEAR(stddev(diagonal), 0.01, 0.002);
  EXPECT_NEAR(stddev(beside), 0.5 * kDegree, 0.1 * kDegree);
  EXPECT_NEAR(stddev(accel_diagonal), 0.02, 0.004);
  EXPECT_NEAR(stddev(accel_beside), 1.0 * kDegree, 0.2 * kDegree);
}

TEST(Sensors, TheGyroscopeFeelsForceAsItIsToldTo) {
  SensorOptions options = silent();
  options.imu.gyro_g_sensitivity = 1e-3;
  std::vector<double> elements;
  for (uint64_t seed = 0; seed < 30; ++seed) {
    const Felt all = felt(options, seed);
    EXPECT_LT(all.accel_error.cwiseAbs().maxCoeff(), 1e-12);
    const auto [sensitivity, residual] = linear_map(all.force, all.gyro_error);
    EXPECT_LT(residual, 1e-9);
    elements.insert(elements.end(), sensitivity.data(), sensitivity.data() + 9);
  }
  EXPECT_NEAR(stddev(elements), 1e-3, 2e-4);
}

TEST(Sensors, VibrationHasItsLevelAndKeepsToItsBand) {
  SensorOptions options = silent();
  options.imu.accel_vibration = 3;
  options.imu.gyro_vibration = 0.05;
  const double rate = 500, seconds = 60;
  const SensorRecord exact = record(silent(), seconds, 1, rate), shaken = record(options, seconds, 1, rate);
  std::vector<double> accel, gyro;
  for (size_t i = 0; i < exact.imu.size(); ++i) {
    accel.push_back(shaken.imu[i].specific_force[1] - exact.imu[i].specific_force[1]);
    gyro.push_back(shaken.imu[i].angular_rate[2] - exact.imu[i].angular_rate[2]);
  }
  EXPECT_NEAR(stddev(accel), 3, 0.1);
  EXPECT_NEAR(stddev(gyro), 0.05, 0.002);
  // Power between two frequencies, by the discrete Fourier transform, as a part of the whole.
  const auto part = [&](double low_hz, double high_hz) {
    double power = 0;
    const auto n = static_cast<double>(accel.size());
    for (double hz = low_hz; hz < high_hz; hz += rate / n) {
      double c = 0, s = 0;
      for (size_t i = 0; i < accel.size(); ++i) {
        const double angle = 2 * std::numbers::pi * hz * static_cast<double>(i) / rate;
        c += accel[i] * std::cos(angle);
        s += accel[i] * std::sin(angle);
      }
      power += 2 * (c * c + s * s) / (n * n);
    }
    return power / 9.0;
  };
  EXPECT_LT(part(5, 19), 0.01);
  EXPECT_LT(part(101, 115), 0.01);
}

TEST(Sensors, StampsDriftAndLostImagesLeaveTheOthersAsTheyWere) {
  SensorOptions options;
  const std::vector<FrameTime> whole = record(options, 120).frames;
  options.camera.dropped = 0.25;
  const std::vector<FrameTime> some = record(options, 120).frames;
  EXPECT_NEAR(static_cast<double>(some.size()) / static_cast<double>(whole.size()), 0.75, 0.05);
  for (const FrameTime& frame : some) {
    EXPECT_EQ(frame.t, whole[frame.index].t);
    EXPECT_EQ(frame.utime, whole[frame.index].utime);
  }
  options = silent();
  options.camera.time_drift_ms_min = 5;
  for (const FrameTime& frame : record(options, 120).frames) {
    EXPECT_NEAR(seconds_of(frame.utime) - frame.t, 0.005 * frame.t / 60, 1.1e-6);
  }
}

TEST(Sensors, ACompassIsOffByItsOffsetWithoutSayingSo) {
  SensorOptions options;
  const SensorRecord before = record(options, 5);
  options.compass.offset_deg = -20;
  const SensorRecord off = record(options, 5);
  for (size_t i = 0; i < before.compass.size(); ++i) {
    EXPECT_NEAR(wrap_angle(off.compass[i].heading - before.compass[i].heading), -20 * kDegree, 1e-9);
    EXPECT_EQ(off.compass[i].heading_stddev, before.compass[i].heading_stddev);
  }
  EXPECT_NEAR(off.truth[0].compass_bias - before.truth[0].compass_bias, -20 * kDegree, 1e-12);
  options.compass.enabled = false;
  const SensorRecord none = record(options, 5);
  EXPECT_TRUE(none.compass.empty());
  EXPECT_EQ(none.imu.back().specific_force[0], before.imu.back().specific_force[0]);
}

TEST(Sensors, OneLevelDoesNotChangeTheNoiseOfTheOthers) {
  SensorOptions options;
  const SensorRecord before = record(options, 5);
  options.imu.gyro_noise = 0;
  options.imu.gyro_scale = 0.1;
  options.imu.gyro_vibration = 1;
  options.imu.gyro_g_sensitivity = 1e-2;
  options.compass.noise_deg = 0;
  options.camera.time_jitter_ms = 0;
  options.camera.dropped = 0.5;
  options.altitude.enabled = true;
  const SensorRecord after = record(options, 5);
  for (size_t i = 0; i < before.imu.size(); ++i) {
    EXPECT_EQ(before.imu[i].specific_force[0], after.imu[i].specific_force[0]);
  }
  for (size_t i = 0; i < before.gnss.size(); ++i) EXPECT_EQ(before.gnss[i].latitude_deg, after.gnss[i].latitude_deg);
  EXPECT_EQ(before.truth.front().compass_bias, after.truth.front().compass_bias);
  EXPECT_EQ(before.truth.back().gyro_bias[2], after.truth.back().gyro_bias[2]);
  EXPECT_TRUE(before.altitude.empty());
  EXPECT_FALSE(after.altitude.empty());
}

TEST(Sensors, MagneticHeadingPlusDeclinationIsTheTrueHeading) {
  const double declination = 0.1;
  SensorOptions options = silent();
  for (const compass_t& compass : record(options, 60).compass) {
    const Eigen::Matrix3d R = flight().at(seconds_of(compass.utime)).R_G_B;
    const double course = std::atan2(R(0, 0), R(1, 0));  // east over north: clockwise from north
    EXPECT_GE(compass.heading, 0);
    EXPECT_LT(compass.heading, 2 * std::numbers::pi);
    EXPECT_NEAR(wrap_angle(compass.heading + declination - course), 0, 1e-3);  // G's north is not quite north
  }
  options.compass.bias_deg = 3;
  options.compass.noise_deg = 1;
  const SensorRecord exact = record(silent(), 60), biased = record(options, 60);
  double mean = 0;
  for (size_t i = 0; i < exact.compass.size(); ++i) {
    mean +=
        wrap_angle(biased.compass[i].heading - exact.compass[i].heading) / static_cast<double>(exact.compass.size());
  }
  EXPECT_NEAR(mean, biased.truth.front().compass_bias, 0.15 * kDegree);
  EXPECT_NEAR(biased.compass.front().heading_stddev, std::sqrt(10.0) * kDegree, 1e-9);
}

TEST(Sensors, CompassBiasIsDrawnPerFlight) {
  SensorOptions options = silent();
  options.compass.bias_deg = 3;
  std::vector<double> biases;
  for (uint64_t seed = 0; seed < 500; ++seed)
    biases.push_back(record(options, 0.2, seed, 10).truth.front().compass_bias);
  EXPECT_NEAR(stddev(biases), 3 * kDegree, 0.3 * kDegree);
}

TEST(Sensors, HalfOfTheReferencesErrorsLieWithinItsCep) {
  SensorOptions options = silent();
  options.gnss.cep_m = 2;
  const EnuFrame frame = surroundings().frame;
  int inside = 0;
  const int flights = 1500;
  for (int seed = 0; seed < flights; ++seed) {
    const SensorRecord r = record(options, 0.2, static_cast<uint64_t>(seed), 10);
    const gnss_reference_t& gnss = r.gnss.back();
    const Eigen::Vector3d p = frame.to_enu({gnss.latitude_deg, gnss.longitude_deg, gnss.ellipsoidal_height});
    inside += (p - flight().at(seconds_of(gnss.utime)).p_G_B).head<2>().norm() < 2.0 ? 1 : 0;
  }
  EXPECT_NEAR(static_cast<double>(inside) / flights, 0.5, 0.05);
}

TEST(Sensors, TheReferencesErrorsChangeSlowly) {
  SensorOptions options = silent();
  options.gnss.cep_m = 2;
  const EnuFrame frame = surroundings().frame;
  double together = 0, square = 0;
  for (uint64_t seed = 0; seed < 40; ++seed) {
    const SensorRecord r = record(options, 130, seed, 10);
    std::vector<double> error;
    for (const gnss_reference_t& g : r.gnss) {
      const Eigen::Vector3d p = frame.to_enu({g.latitude_deg, g.longitude_deg, g.ellipsoidal_height});
      error.push_back((p - flight().at(seconds_of(g.utime)).p_G_B).x());
    }
    for (size_t i = 0; i + 600 < error.size(); i += 50) {
      together += error[i] * error[i + 600];  // 60 s apart
      square += error[i] * error[i];
    }
  }
  EXPECT_NEAR(together / square, std::exp(-1.0), 0.2);
}

TEST(Sensors, TruthIsThereForEveryImageAndIsTheTruth) {
  const SensorRecord r = record(SensorOptions(), 30);
  const SensorSurroundings around = surroundings();
  ASSERT_TRUE(std::is_sorted(r.truth.begin(), r.truth.end(),
                             [](const truth_t& a, const truth_t& b) { return a.utime < b.utime; }));
  for (const FrameTime& frame : r.frames) {
    EXPECT_TRUE(std::any_of(r.truth.begin(), r.truth.end(), [&](const truth_t& t) { return t.utime == frame.utime; }));
  }
  for (const truth_t& truth : r.truth) {
    const MotionState state = flight().at(seconds_of(truth.utime));
    const Eigen::Vector3d p = around.frame.to_enu({truth.latitude_deg, truth.longitude_deg, truth.ellipsoidal_height});
    EXPECT_LT((p - state.p_G_B).norm(), 1e-6);
    const Eigen::Quaterniond q(truth.q_ENU_B[0], truth.q_ENU_B[1], truth.q_ENU_B[2], truth.q_ENU_B[3]);
    EXPECT_LT(q.angularDistance(Eigen::Quaterniond(around.frame.R_local_G(p) * state.R_G_B)), 1e-9);
    EXPECT_NEAR(truth.height_above_ground, state.p_G_B.z() - 2.0, 1e-9);
    EXPECT_NEAR(truth.map_offset_en[0], 0.5, 1e-12);
    EXPECT_NEAR(truth.map_offset_en[1], 1e-3 * state.p_G_B.y(), 1e-9);
    EXPECT_EQ(truth.magnetic_declination, 0.1);
  }
}

TEST(Sensors, FrameStampsJitterAroundTheTrueTimePlusTheOffset) {
  SensorOptions options = silent();
  options.camera.time_jitter_ms = 0.5;
  options.camera.time_offset_ms = 7;
  std::vector<double> errors;
  for (const FrameTime& frame : record(options, 400, 1, 10).frames) {
    errors.push_back(1e3 * (seconds_of(frame.utime) - frame.t) - 7);
  }
  ASSERT_GT(errors.size(), 3990U);
  EXPECT_NEAR(stddev(errors), 0.5, 0.03);
  options.camera.time_jitter_ms = 100;
  EXPECT_THROW(record(options, 400, 1, 10), std::invalid_argument);
}

TEST(Sensors, HeightAboveGroundHasItsBiasAndNoise) {
  SensorOptions options = silent();
  options.altitude.enabled = true;
  options.altitude.noise_m = 0.5;
  std::vector<double> errors;
  for (const altitude_t& altitude : record(options, 100).altitude) {
    errors.push_back(altitude.height_above_ground - (flight().at(seconds_of(altitude.utime)).p_G_B.z() - 2.0));
  }
  EXPECT_NEAR(stddev(errors), 0.5, 0.05);
}

}  // namespace
}  // namespace orthonav::simulate
