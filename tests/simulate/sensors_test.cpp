#include "tools/simulate/sensors.h"

#include <algorithm>
#include <numbers>

#include <gtest/gtest.h>

#include "common/math/so3.h"
#include "tests/simulate/flight_fixtures.h"
#include "tools/simulate/flight_plan.h"

namespace orthonav::simulate {
namespace {

constexpr double kDegree = std::numbers::pi / 180.0;
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

TEST(Sensors, OneLevelDoesNotChangeTheNoiseOfTheOthers) {
  SensorOptions options;
  const SensorRecord before = record(options, 5);
  options.imu.gyro_noise = 0;
  options.compass.noise_deg = 0;
  options.camera.time_jitter_ms = 0;
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
