// Every parameter of the fusion. config/default/fusion.yaml says what each is for, with its unit; angles here are rad.
#pragma once

#include <filesystem>
#include <numbers>

namespace orthonav::fusion {

inline constexpr double kDegree = std::numbers::pi / 180.0;

// How well the odometry knows the motion from one keyframe to the next.
struct EdgeOptions {
  double position_walk = 6e-4;          // of the height above ground, per axis and square root of a second
  double default_height = 150.0;        // m, where the height above ground is unknown
  double turn_walk = 0.007 * kDegree;   // rad per axis and square root of a second, of the odometry's attitude
  bool use_odometry_covariance = true;  // in place of the above where the keyframe carries one, if it is larger
  double lean_stddev = 0.4 * kDegree;   // rad per axis, of the odometry's vertical, at least: its own word, if larger
  double scale_stddev = 0.02;           // of the odometry's scale, as a fraction
  double start_scale_stddev = 0.1;      // the same at the start of a session, when it is not settled yet
  double scale_time = 600.0;            // s, over which it forgets
  double velocity_stddev = 1.0e-4;      // 1/s, of the odometry's velocity per axis, over the height above ground
};

// How well a fix is known.
struct FixOptions {
  double shared_horizontal_stddev = 0.5;  // m per axis: an error that neighbouring fixes share and none reports
  double shared_vertical_stddev = 1.0;    // m
  double shared_distance = 40.0;          // m of way over which it is forgotten, horizontally
  double shared_vertical_distance = 200;  // m, vertically
  double stddev_floor = 0.5;              // m per axis, added to what a fix says of itself
  double tilt_distance = 0.25;            // of the height: way over which what a fix's tilt errs by is forgotten
  double heading_stddev_floor =
      1.5 * kDegree;                 // rad, added to a fitted heading's own: neighbours err alike, towards the compass
  double scale_stddev_floor = 0.05;  // added to a fitted scale's own: all of a flight err alike by 1 %
  double default_stddev = 5.0;       // m per axis where the fix carries no covariance
  double huber = 1.5;                // standard deviations from which a fix counts linearly, equation (15)
};

// How well the compass is known, and headings of fixes that come from it.
struct CompassOptions {
  double bias_stddev = 5 * kDegree;   // rad, of the installation
  double bias_time = 600.0;           // s, over which it forgets
  double noise_stddev = 3 * kDegree;  // rad, of one reading: nearby iron, tilt
  double innovation = 4.0;            // Mahalanobis distance above which a reading is not used
  double huber = 2.0;                 // standard deviations from which it counts linearly
  double fix_stddev = 5 * kDegree;    // rad, of the heading of a fix that carries none
};

// When a place is believed, and when it is left for another one.
struct LockOptions {
  double probability = 0.999;     // of a place that is believed
  double fix_probability = 0.99;  // of a fix that does not say, and of any to err by no more than it says
  double wrong_distance = 6.0;    // m of way beyond which a wrong place seldom moves with the aircraft,
  double wrong_height = 0.055;    // and this share of the height at least: the higher, the longer the same is in view
  double jump_time = 18000.0;     // s in which an odometry jumps once without saying so
  double innovation = 4.0;        // Mahalanobis distance from the solution above which a fix is an outlier
};

// Bounds of the error that hold though fixes may be wrong.
struct ProtectionOptions {
  double exposure = 30.0;     // s: all fixes of the newest stretch of this length may be wrong at once
  double lost_level = 100.0;  // m: with a larger horizontal level the position counts as lost
};

// Propagation by the inertial sensor between odometry states, and while the odometry restarts.
struct InertialOptions {
  double gravity = 9.81;                     // m/s^2; aircraft.yaml, imu
  double accel_noise = 2e-3;                 // m/s^2/sqrt(Hz); aircraft.yaml, imu
  double gyro_noise = 1.7e-4;                // rad/s/sqrt(Hz); aircraft.yaml, imu
  double accel_bias_stddev = 0.05;           // m/s^2, of the bias that the odometry gives
  double gyro_bias_stddev = 0.06 * kDegree;  // rad/s, of the bias that the odometry gives
  double max_gap = 0.05;          // s without a sample, beyond which the motion between is a guess: straight on,
  double bridged_gap = 2.0;       // and up to so many s it is one, with these uncertainties; beyond, nothing is known
  double gap_accel_stddev = 1.5;  // m/s^2, of the mean acceleration in a gap
  double gap_tilt_stddev = 5.7 * kDegree;   // rad per axis, of the change of tilt over a gap
  double gap_turn_stddev = 11.5 * kDegree;  // rad/s, of the mean rate of turn in a gap
  double max_time = 10.0;                   // s without an odometry state after which there is no position
};

struct FusionOptions {
  int window_keyframes = 200;   // nodes that are optimised; older ones become a prior. 0: the whole trajectory
  int max_iterations = 4;       // of a solution, which starts at the last one
  double coasting_after = 5.0;  // s without a fix
  double reacquired_for = 5.0;  // s that the mode says so
  double reset_jump = 5.0;      // m: a correction larger than this increments the reset counter
  double max_speed = 100.0;     // m/s: faster odometry is a failure
  double memory_age = 15.0;     // s: what was known so long ago is not gone on with after a restart of the fusion
  double declination = 0.0;     // rad, east positive; aircraft.yaml
  EdgeOptions edge;
  FixOptions fix;
  CompassOptions compass;
  LockOptions lock;
  ProtectionOptions protection;
  InertialOptions inertial;

  // Reads fusion.yaml, and of aircraft.yaml what it needs. Throws ConfigError with file and line.
  static FusionOptions load(const std::filesystem::path& folder);
};

}  // namespace orthonav::fusion
