#include "services/fusion/options.h"

#include "common/config/config.h"

namespace orthonav::fusion {
namespace {

// Reads an angle that the file gives in degrees.
void read_deg(ConfigNode& node, const char* key, double& radians, double high_deg) {
  double degrees = radians / kDegree;
  node.read(key, degrees, 1e-6, high_deg);
  radians = degrees * kDegree;
}

void read_edge(ConfigNode node, EdgeOptions& edge) {
  node.read("position_walk", edge.position_walk, 1e-7, 1.0);
  node.read("default_height", edge.default_height, 1.0, 1e5);
  read_deg(node, "turn_walk_deg", edge.turn_walk, 90.0);
  node.read("use_odometry_covariance", edge.use_odometry_covariance);
  read_deg(node, "lean_stddev_deg", edge.lean_stddev, 20.0);
  node.read("scale_stddev", edge.scale_stddev, 1e-5, 1.0);
  node.read("start_scale_stddev", edge.start_scale_stddev, 1e-5, 1.0);
  node.read("scale_time", edge.scale_time, 0.1, 1e6);
  node.read("velocity_stddev", edge.velocity_stddev, 0.0, 100.0);
  node.finish();
}

void read_fix(ConfigNode node, FixOptions& fix) {
  node.read("shared_horizontal_stddev", fix.shared_horizontal_stddev, 1e-3, 1000.0);
  node.read("shared_vertical_stddev", fix.shared_vertical_stddev, 1e-3, 1000.0);
  node.read("shared_distance", fix.shared_distance, 0.1, 1e6);
  node.read("shared_vertical_distance", fix.shared_vertical_distance, 0.1, 1e6);
  node.read("stddev_floor", fix.stddev_floor, 1e-3, 1000.0);
  node.read("tilt_distance", fix.tilt_distance, 1e-3, 1e3);
  read_deg(node, "heading_stddev_floor_deg", fix.heading_stddev_floor, 180.0);
  node.read("scale_stddev_floor", fix.scale_stddev_floor, 0.0, 1.0);
  node.read("default_stddev", fix.default_stddev, 1e-3, 1000.0);
  node.read("huber", fix.huber, 0.1, 1000.0);
  node.finish();
}

void read_compass(ConfigNode node, CompassOptions& compass) {
  read_deg(node, "bias_stddev_deg", compass.bias_stddev, 180.0);
  node.read("bias_time", compass.bias_time, 0.1, 1e6);
  read_deg(node, "noise_stddev_deg", compass.noise_stddev, 180.0);
  node.read("innovation", compass.innovation, 0.1, 1e9);
  node.read("huber", compass.huber, 0.1, 1000.0);
  read_deg(node, "fix_stddev_deg", compass.fix_stddev, 180.0);
  node.finish();
}

void read_lock(ConfigNode node, LockOptions& lock) {
  node.read("probability", lock.probability, 0.5, 0.999999);
  node.read("fix_probability", lock.fix_probability, 0.01, 0.999999);
  node.read("wrong_distance", lock.wrong_distance, 0.1, 1e4);
  node.read("wrong_height", lock.wrong_height, 0.0, 10.0);
  node.read("jump_time", lock.jump_time, 1.0, 1e9);
  node.read("innovation", lock.innovation, 0.1, 1e9);
  node.finish();
}

void read_protection(ConfigNode node, ProtectionOptions& protection) {
  node.read("exposure", protection.exposure, 0.0, 1e6);
  node.read("lost_level", protection.lost_level, 1.0, 1e6);
  node.finish();
}

void read_inertial(ConfigNode node, InertialOptions& inertial) {
  node.read("accel_bias_stddev", inertial.accel_bias_stddev, 0.0, 10.0);
  read_deg(node, "gyro_bias_stddev_deg", inertial.gyro_bias_stddev, 90.0);
  node.read("max_gap", inertial.max_gap, 1e-3, 10.0);
  node.read("bridged_gap", inertial.bridged_gap, 0.0, 10.0);
  node.read("gap_accel_stddev", inertial.gap_accel_stddev, 0.0, 100.0);
  read_deg(node, "gap_tilt_stddev_deg", inertial.gap_tilt_stddev, 90.0);
  read_deg(node, "gap_turn_stddev_deg", inertial.gap_turn_stddev, 360.0);
  node.read("max_time", inertial.max_time, 0.1, 600.0);
  node.finish();
}

// aircraft.yaml has parts that are other services' to read, so not every key of it is known here.
void read_aircraft(ConfigNode aircraft, FusionOptions& options) {
  double declination_deg = 0.0;
  aircraft.require("magnetic_declination_deg", declination_deg);
  options.declination = declination_deg * kDegree;
  ConfigNode imu = aircraft.child("imu");
  imu.read("gravity", options.inertial.gravity, 9.0, 10.0);
  imu.read("accel_noise", options.inertial.accel_noise, 1e-9, 10.0);
  imu.read("gyro_noise", options.inertial.gyro_noise, 1e-9, 10.0);
}

}  // namespace

FusionOptions FusionOptions::load(const std::filesystem::path& folder) {
  FusionOptions options;
  ConfigNode node = ConfigNode::load(folder / "fusion.yaml");
  node.read("window_keyframes", options.window_keyframes, 0, 1000000);
  if (options.window_keyframes == 1) node.fail("window_keyframes", "a window needs at least two keyframes");
  node.read("max_iterations", options.max_iterations, 1, 100);
  node.read("coasting_after", options.coasting_after, 0.0, 3600.0);
  node.read("reacquired_for", options.reacquired_for, 0.0, 3600.0);
  node.read("reset_jump", options.reset_jump, 0.0, 1e6);
  node.read("max_speed", options.max_speed, 1.0, 1000.0);
  node.read("memory_age", options.memory_age, 0.0, 3600.0);
  read_edge(node.child_or_empty("edge"), options.edge);
  read_fix(node.child_or_empty("fix"), options.fix);
  read_compass(node.child_or_empty("compass"), options.compass);
  read_lock(node.child_or_empty("lock"), options.lock);
  read_protection(node.child_or_empty("protection"), options.protection);
  read_inertial(node.child_or_empty("inertial"), options.inertial);
  node.finish();
  read_aircraft(ConfigNode::load(folder / "aircraft.yaml"), options);
  return options;
}

}  // namespace orthonav::fusion
