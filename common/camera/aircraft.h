// A folder's aircraft.yaml, with what Kalibr measured in place of what was typed in.
//
// Every reader of aircraft.yaml opens it here, so that a calibration is used by all of them or by none. With
//
//   kalibr:
//     camchain: camchain-imucam.yaml   # of kalibr_calibrate_imu_camera; relative to aircraft.yaml
//     imu: imu.yaml                    # optional: the noise densities Kalibr was given
//     camera: cam0                     # which camera of the chain; default cam0
//
// the keys `camera`, `extrinsics` (with the time offset) and the noise and rate of `imu` come from Kalibr's files and
// win over the same keys of aircraft.yaml and of what it extends. Supported: camera_model pinhole with
// distortion_model radtan or equidistant. B is the IMU's frame: the IMU's axes must be x forward, y left, z up.
#pragma once

#include <filesystem>

#include "common/config/config.h"

namespace orthonav {

// Opens `folder`/aircraft.yaml. Throws ConfigError with file and line: also for a Kalibr file that is missing, that
// has another lens model, or whose T_cam_imu is no rigid transformation.
ConfigNode load_aircraft(const std::filesystem::path& folder);

}  // namespace orthonav
