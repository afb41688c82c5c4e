#include "services/vio/options.h"

#include "common/camera/aircraft.h"
#include "common/config/config.h"

namespace orthonav::vio {
namespace {

void read_tracker(ConfigNode node, TrackerOptions& options) {
  node.read("max_features", options.max_features, 20, 1000);
  node.read("corner_quality", options.corner_quality, 0.0, 1.0);
  node.read("border", options.border, 1.0, 100.0);
  node.read("search_window", options.search_window, 5, 51);
  node.read("pyramid_levels", options.pyramid_levels, 0, 8);
  node.read("round_trip", options.round_trip, 0.01, 10.0);
  node.read("outlier_distance", options.outlier_distance, 0.1, 20.0);
  node.finish();
}

void read_estimator(ConfigNode node, EstimatorOptions& options) {
  node.read("window", options.window, 4, 50);
  node.read("keyframe_parallax", options.keyframe_parallax, 1.0, 200.0);
  node.read("keyframe_tracked", options.keyframe_tracked, 0.0, 1.0);
  node.read("pixel_sigma", options.pixel_sigma, 0.01, 10.0);
  node.read("max_pixel_sigma", options.max_pixel_sigma, options.pixel_sigma, 10.0);
  node.read("robust_width", options.robust_width, 0.1, 100.0);
  node.read("outlier_error", options.outlier_error, 0.5, 50.0);
  node.read("min_parallax", options.min_parallax, 0.1, 100.0);
  node.read("iterations", options.iterations, 1, 100);
  node.read("accel_bias_sigma", options.accel_bias_sigma, 1e-6, 10.0);
  node.read("gyro_bias_sigma", options.gyro_bias_sigma, 1e-6, 1.0);
  node.read("tilt_return_time", options.tilt_return_time, 0.1, 1e6);
  node.read("keyframe_interval", options.keyframe_interval, 0.2, 60.0);
  node.read("estimate_time_offset", options.estimate_time_offset);
  node.read("time_offset_sigma", options.time_offset_sigma, 1e-5, 0.1);
  node.read("max_time_offset", options.max_time_offset, 0.0, 0.2);
  node.read("refine_extrinsics", options.refine_extrinsics);
  node.read("extrinsics_sigma_deg", options.extrinsics_sigma_deg, 1e-3, 20.0);
  node.read("extrinsics_sigma_m", options.extrinsics_sigma_m, 1e-4, 1.0);
  node.read("use_altitude", options.use_altitude);
  node.read("altitude_bias_sigma", options.altitude_bias_sigma, 1e-3, 1e3);
  node.read("altitude_relief", options.altitude_relief, 0.0, 1e3);
  node.read("max_rescale", options.max_rescale, 0.01, 1.0);
  node.read("max_error_time", options.max_error_time, 0.1, 60.0);
  node.read("init_interval", options.init_interval, 0.02, 10.0);
  node.read("init_parallax", options.init_parallax, 1.0, 200.0);
  node.read("init_min_time", options.init_min_time, 0.1, 60.0);
  node.read("init_scale_sigma", options.init_scale_sigma, 1e-3, 1.0);
  node.read("max_accel_bias", options.max_accel_bias, 0.01, 100.0);
  node.read("max_gyro_bias", options.max_gyro_bias, 0.001, 10.0);
  node.read("max_speed", options.max_speed, 0.1, 1000.0);
  node.read("min_landmarks", options.min_landmarks, 4, 1000);
  node.read("degraded_landmarks", options.degraded_landmarks, 4, 1000);
  node.read("blind_time", options.blind_time, 0.1, 60.0);
  node.finish();
}

}  // namespace

VioSetup load_setup(const std::filesystem::path& folder) {
  ConfigNode aircraft = load_aircraft(folder);
  ConfigNode camera = aircraft.child("camera");
  ConfigNode extrinsics = aircraft.child("extrinsics");
  VioSetup setup{{}, CameraModel::from_config(camera), Extrinsics::from_config(extrinsics)};
  camera.finish();
  extrinsics.finish();

  ConfigNode imu = aircraft.child("imu");
  imu.read("gyro_noise", setup.options.imu.gyro_noise, 1e-9, 1.0);
  imu.read("gyro_walk", setup.options.imu.gyro_walk, 1e-9, 1.0);
  imu.read("accel_noise", setup.options.imu.accel_noise, 1e-9, 10.0);
  imu.read("accel_walk", setup.options.imu.accel_walk, 1e-9, 10.0);
  imu.read("gravity", setup.options.estimator.gravity, 9.0, 10.5);
  // The rest of aircraft.yaml is other services' business, so it is not finished here.

  ConfigNode vio = ConfigNode::load(folder / "vio.yaml");
  read_tracker(vio.child_or_empty("tracker"), setup.options.tracker);
  read_estimator(vio.child_or_empty("estimator"), setup.options.estimator);
  ConfigNode calibration = vio.child_or_empty("calibration");
  calibration.read("max_rotation_deg", setup.options.calibration.max_rotation_deg, 0.1, 180.0);
  calibration.read("significance", setup.options.calibration.significance, 1.0, 100.0);
  calibration.read("max_gravity_error", setup.options.calibration.max_gravity_error, 0.01, 10.0);
  calibration.finish();
  vio.read("camera_time_offset", setup.options.estimator.time_offset, -1.0, 1.0);
  setup.options.estimator.time_offset += setup.extrinsics.time_offset;
  vio.read("readout_time", setup.options.readout_time, -0.1, 0.1);
  vio.read("max_imu_gap", setup.options.max_imu_gap, 0.01, 10.0);
  vio.read("gyro_range", setup.options.gyro_range, 0.1, 1000.0);
  vio.read("accel_range", setup.options.accel_range, 10.0, 10000.0);
  vio.read("fusion_hint", setup.options.fusion_hint);
  vio.read("hint_distance", setup.options.hint_distance, 10.0, 10000.0);
  vio.finish();
  return setup;
}

}  // namespace orthonav::vio
