// A scenario's folder as the simulator reads it: simulate.yaml and aircraft.yaml.
#pragma once

#include <filesystem>

#include "common/camera/camera_model.h"
#include "common/config/config.h"
#include "tools/simulate/camera_effects.h"
#include "tools/simulate/flight_plan.h"
#include "tools/simulate/sensors.h"

namespace orthonav::simulate {

// What the services are told of the aircraft's inertial sensor (aircraft.yaml), which need not be what it really does
// (SensorOptions::Imu).
struct ImuCalibration {
  double gyro_noise = 1.7e-4;   // rad/s/sqrt(Hz)
  double gyro_walk = 1.9e-5;    // rad/s^2/sqrt(Hz)
  double accel_noise = 2.0e-3;  // m/s^2/sqrt(Hz)
  double accel_walk = 3.0e-3;   // m/s^3/sqrt(Hz)
  double rate_hz = 200.0;       // Hz
  double gravity = 9.81;        // m/s^2
};

struct Scenario {
  ConfigNode world;  // for make_world
  FlightOptions flight;
  CameraEffectOptions camera_effects;
  SensorOptions sensors;
  double record_s = 0;       // s of the flight that are recorded; 0: all of it
  int64_t start_unix_s = 0;  // s since the Unix epoch, of the first measurement
  CameraModel camera;
  Extrinsics extrinsics;
  ImuCalibration imu;
  double magnetic_declination = 0;  // rad, east positive

  // Throws ConfigError with file and line.
  static Scenario load(const std::filesystem::path& folder);
};

}  // namespace orthonav::simulate
