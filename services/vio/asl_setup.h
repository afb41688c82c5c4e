// The calibration that comes with a dataset in EuRoC/ASL layout, in place of aircraft.yaml's.
#pragma once

#include <filesystem>

#include "services/vio/options.h"

namespace orthonav::vio {

// Camera, extrinsics and IMU noise of `folder`/mav0/cam0/sensor.yaml and mav0/imu0/sensor.yaml (`folder` holds mav0/,
// or is it), with the other options of `base`. The extrinsics are T_BS of the camera; the IMU is the body. Throws
// std::runtime_error naming the file at fault.
VioSetup load_asl_setup(const std::filesystem::path& folder, const VioOptions& base);

}  // namespace orthonav::vio
