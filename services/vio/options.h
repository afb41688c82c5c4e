// Everything that vio is configured with: vio.yaml, and the camera, extrinsics and IMU of aircraft.yaml.
#pragma once

#include <filesystem>

#include "common/camera/camera_model.h"
#include "services/vio/calibration_check.h"
#include "services/vio/estimator.h"
#include "services/vio/tracker.h"

namespace orthonav::vio {

struct VioOptions {
  TrackerOptions tracker;
  EstimatorOptions estimator;
  ImuNoise imu;
  CalibrationCheckOptions calibration;
  double readout_time = 0;     // s, of a rolling shutter, from the first row to the last; 0: global shutter
  double max_imu_gap = 0.6;    // s: a longer gap in the IMU cannot be bridged and restarts the odometry
  double gyro_range = 17.45;   // rad/s: an axis that reads as much is saturated
  double accel_range = 156;    // m/s^2: likewise
  bool fusion_hint = false;    // the scale of the fused trajectory is taken back
  double hint_distance = 150;  // m, over which it is compared
};

struct VioSetup {
  VioOptions options;
  CameraModel camera;
  Extrinsics extrinsics;
};

// Reads `folder`/vio.yaml and `folder`/aircraft.yaml. Throws ConfigError with file and line.
VioSetup load_setup(const std::filesystem::path& folder);

}  // namespace orthonav::vio
