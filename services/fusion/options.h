// Every parameter of the fusion.
#pragma once

#include <filesystem>

namespace orthonav::fusion {

// How well a relative pose of the odometry is known.
struct EdgeOptions {
  double position_stddev = 0.05;            // m per edge, per axis
  double position_stddev_per_metre = 0.02;  // of the edge's length: local errors of scale and direction
  double rotation_stddev = 0.0005;          // rad per edge, per axis
  double rotation_walk = 0.001;             // rad per square root of a second, per axis
  // Whether relative_covariance of the keyframe, where known, is added to the above.
  bool use_odometry_covariance = true;
  double tilt_stddev = 0.02;   // rad, of the odometry's "up", per keyframe
  double scale_stddev = 0.05;  // of the odometry's scale at the start of a segment, as a fraction
  double scale_walk = 0.002;   // change of scale per square root of a second, as a fraction
};

// How well a fix is known.
struct FixOptions {
  double horizontal_stddev_floor = 3.0;  // m per axis: errors that neighbouring fixes share and no fix reports
  double vertical_stddev_floor = 6.0;    // m
  double default_stddev = 5.0;           // m per axis where the fix carries no covariance
  double default_heading_stddev = 0.09;  // rad, where the fix carries none
  bool height_from_odometry = true;      // the fix's height over the ground has the odometry's scale
  double huber = 1.5;                    // standard deviations from which a fix counts linearly, equation (15)
};

// When fixes are believed.
struct GateOptions {
  int memory = 100;         // newest fixes, believed or not, that are searched for agreement
  int lock_fixes = 3;       // fixes that must agree with each other before the first position
  int relock_fixes = 5;     // the same, at least, to move a solution; they must also outnumber those believed
  double agreement = 3.0;   // Mahalanobis distance below which two fixes agree about the motion between them
  double innovation = 4.0;  // Mahalanobis distance from the solution above which a fix is an outlier
};

struct FusionOptions {
  int window_keyframes = 200;   // nodes that are optimised; older ones become a prior. 0: the whole trajectory
  int max_iterations = 4;       // of a solution, which starts at the last one
  double coasting_after = 5.0;  // s without a fix
  double reset_jump = 5.0;      // m: a correction larger than this increments the reset counter
  double max_speed = 100.0;     // m/s: faster odometry is a failure
  EdgeOptions edge;
  FixOptions fix;
  GateOptions gate;

  // Reads fusion.yaml. Throws ConfigError with file and line.
  static FusionOptions load(const std::filesystem::path& file);
};

}  // namespace orthonav::fusion
