// The sensors of a flight, but for the camera: inertial, compass, height, satellite reference, and the truth.
//
// Every sensor draws from random streams of its own, so changing one level leaves the others' noise as it was.
#pragma once

#include <cstdint>
#include <functional>
#include <string>
#include <vector>

#include "common/geo/enu_frame.h"
#include "orthonav/altitude_t.hpp"
#include "orthonav/compass_t.hpp"
#include "orthonav/gnss_reference_t.hpp"
#include "orthonav/imu_t.hpp"
#include "orthonav/truth_t.hpp"
#include "tools/simulate/trajectory.h"

namespace orthonav {
class ConfigNode;
}

namespace orthonav::simulate {

struct SensorOptions {
  struct Imu {
    double gyro_noise = 1.7e-4;   // rad/s/sqrt(Hz), white
    double gyro_walk = 1.9e-5;    // rad/s^2/sqrt(Hz), random walk of the bias
    double gyro_turn_on = 0.01;   // rad/s, 1 sigma per axis of the bias at the start
    double accel_noise = 2.0e-3;  // m/s^2/sqrt(Hz), white
    double accel_walk = 3.0e-3;   // m/s^3/sqrt(Hz), random walk of the bias
    double accel_turn_on = 0.05;  // m/s^2, 1 sigma per axis of the bias at the start
    double gyro_scale = 0.0;      // 1 sigma per axis of the scale factor's error, drawn per flight
    double accel_scale = 0.0;
    double gyro_misalignment_deg = 0.0;  // degrees, 1 sigma, by which an axis leans to each of the others
    double accel_misalignment_deg = 0.0;
    double gyro_g_sensitivity = 0.0;  // rad/s per m/s^2, 1 sigma per pair of axes, of what the gyroscope feels of force
    double gyro_vibration = 0.0;   // rad/s per axis, root mean square, of the part on its mount: no other sensor moves
    double accel_vibration = 0.0;  // m/s^2, likewise
    double vibration_low_hz = 20.0;  // Hz, band of the vibration
    double vibration_high_hz = 100.0;
  } imu;
  struct Camera {
    double rate_hz = 10.0;           // Hz
    double time_offset_ms = 0.0;     // ms, stamp minus true middle of the exposure, constant
    double time_jitter_ms = 0.2;     // ms, 1 sigma, of the stamp
    double time_drift_ms_min = 0.0;  // ms per minute, by which the stamps gain on the true time
    double dropped = 0.0;            // part of the images that is lost, one by one
  } camera;
  struct Compass {
    bool enabled = true;
    double rate_hz = 10.0;    // Hz
    double bias_deg = 3.0;    // degrees, 1 sigma, of the heading bias drawn per flight
    double offset_deg = 0.0;  // degrees, of every heading, of which the stated deviation knows nothing
    double noise_deg = 1.0;   // degrees, 1 sigma, white
  } compass;
  struct Altitude {
    bool enabled = false;
    double rate_hz = 10.0;  // Hz
    double bias_m = 1.0;    // m, 1 sigma, of the bias drawn per flight
    double noise_m = 0.5;   // m, 1 sigma, white
  } altitude;
  struct Gnss {
    double rate_hz = 10.0;             // Hz
    double cep_m = 2.0;                // m, radius that holds half of the horizontal errors
    double correlation_time_s = 60.0;  // s
    double white_fraction = 0.1;       // of the error's standard deviation that is white
    double vertical_ratio = 1.5;       // vertical standard deviation over the horizontal one per axis
  } gnss;
  double truth_rate_hz = 20.0;  // Hz, besides the times of the images

  static SensorOptions from_config(ConfigNode& node);
};

// The world around the sensors.
struct SensorSurroundings {
  EnuFrame frame;                                                          // G
  std::function<double(const Eigen::Vector2d& p_en)> surface;              // height in G, m
  std::function<Eigen::Vector2d(const Eigen::Vector2d& p_en)> map_offset;  // as World::map_offset
  double magnetic_declination = 0;                                         // rad, east positive
  int64_t start_utime = 0;                                                 // of t = 0
};

// When a picture was taken and what its clock said.
struct FrameTime {
  double t = 0;       // s, true middle of the exposure
  int64_t utime = 0;  // the stamp
  size_t index = 0;   // of the exposure, those counted that were lost
};

struct SensorRecord {
  std::vector<imu_t> imu;
  std::vector<compass_t> compass;
  std::vector<altitude_t> altitude;
  std::vector<gnss_reference_t> gnss;
  std::vector<truth_t> truth;  // at the truth rate and at the stamps of the frames
  std::vector<FrameTime> frames;
};

// All measurements of the first `seconds` of a flight, each sequence in time order. `imu_rate_hz` is the aircraft's.
// Throws std::invalid_argument when the jitter of the camera's stamps would put frames out of order.
SensorRecord simulate_sensors(const Trajectory& trajectory, double seconds, double imu_rate_hz,
                              const SensorOptions& options, const SensorSurroundings& around, uint64_t seed);

}  // namespace orthonav::simulate
