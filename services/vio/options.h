// Everything that vio is configured with: vio.yaml, and the camera, extrinsics and IMU of aircraft.yaml.
#pragma once

#include <filesystem>

#include "common/camera/camera_model.h"
#include "services/vio/estimator.h"
#include "services/vio/tracker.h"

namespace orthonav::vio {

struct VioOptions {
  TrackerOptions tracker;
  EstimatorOptions estimator;
  ImuNoise imu;
  double camera_time_offset = 0;  // s: IMU time = image time + offset, that of the extrinsics included
  double max_imu_gap = 0.25;      // s: a longer gap in the IMU cannot be bridged and restarts the odometry
};

struct VioSetup {
  VioOptions options;
  CameraModel camera;
  Extrinsics extrinsics;
};

// Reads `folder`/vio.yaml and `folder`/aircraft.yaml. Throws ConfigError with file and line.
VioSetup load_setup(const std::filesystem::path& folder);

}  // namespace orthonav::vio
