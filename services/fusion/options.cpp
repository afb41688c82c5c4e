#include "services/fusion/options.h"

#include <numbers>

#include "common/config/config.h"

namespace orthonav::fusion {
namespace {

constexpr double kRadPerDeg = std::numbers::pi / 180.0;

// Reads an angle that the file gives in degrees.
void read_deg(ConfigNode& node, const char* key, double& radians, double high_deg) {
  double degrees = radians / kRadPerDeg;
  node.read(key, degrees, 1e-6, high_deg);
  radians = degrees * kRadPerDeg;
}

void read_edge(ConfigNode node, EdgeOptions& edge) {
  node.read("position_stddev", edge.position_stddev, 1e-4, 100.0);
  node.read("position_stddev_per_metre", edge.position_stddev_per_metre, 0.0, 1.0);
  read_deg(node, "rotation_stddev_deg", edge.rotation_stddev, 90.0);
  read_deg(node, "rotation_walk_deg", edge.rotation_walk, 90.0);
  node.read("use_odometry_covariance", edge.use_odometry_covariance);
  read_deg(node, "tilt_stddev_deg", edge.tilt_stddev, 180.0);
  node.read("scale_stddev", edge.scale_stddev, 0.0, 1.0);
  node.read("scale_walk", edge.scale_walk, 0.0, 1.0);
  node.finish();
}

void read_fix(ConfigNode node, FixOptions& fix) {
  node.read("horizontal_stddev_floor", fix.horizontal_stddev_floor, 1e-3, 1000.0);
  node.read("vertical_stddev_floor", fix.vertical_stddev_floor, 1e-3, 1000.0);
  node.read("default_stddev", fix.default_stddev, 1e-3, 1000.0);
  read_deg(node, "default_heading_stddev_deg", fix.default_heading_stddev, 180.0);
  node.read("height_from_odometry", fix.height_from_odometry);
  node.read("huber", fix.huber, 0.1, 1000.0);
  node.finish();
}

void read_gate(ConfigNode node, GateOptions& gate) {
  node.read("memory", gate.memory, 1, 1000);
  node.read("lock_fixes", gate.lock_fixes, 1, 100);
  node.read("agreement", gate.agreement, 0.1, 1000.0);
  node.read("innovation", gate.innovation, 0.1, 1e9);
  node.read("relock_fixes", gate.relock_fixes, 1, 1000);
  node.finish();
}

}  // namespace

FusionOptions FusionOptions::load(const std::filesystem::path& file) {
  FusionOptions options;
  ConfigNode node = ConfigNode::load(file);
  node.read("window_keyframes", options.window_keyframes, 0, 1000000);
  if (options.window_keyframes == 1) node.fail("window_keyframes", "a window needs at least two keyframes");
  node.read("max_iterations", options.max_iterations, 1, 100);
  node.read("coasting_after", options.coasting_after, 0.0, 3600.0);
  node.read("reset_jump", options.reset_jump, 0.0, 1e6);
  node.read("max_speed", options.max_speed, 1.0, 1000.0);
  read_edge(node.child_or_empty("edge"), options.edge);
  read_fix(node.child_or_empty("fix"), options.fix);
  read_gate(node.child_or_empty("gate"), options.gate);
  node.finish();
  return options;
}

}  // namespace orthonav::fusion
