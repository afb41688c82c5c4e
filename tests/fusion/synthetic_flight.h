// Odometry, fixes, compass and inertial samples of a made-up flight, without images: what the fusion's tests and
// benchmarks fly.
//
// The odometry drifts as a monocular one does (scale wrong and wandering, heading wandering, position noise); fixes
// have white noise, an error that neighbours share, and wrong ones that come singly and in runs with one offset.
#pragma once

#include <cstdint>
#include <vector>

#include "services/fusion/types.h"

namespace orthonav::fusion {

struct SyntheticOptions {
  double duration = 448.0;         // s
  double speed = 2.63;             // m/s along the path
  double height = 110.0;           // m
  double keyframe_interval = 0.3;  // s
  double scale_stddev = 0.03;      // of the odometry's scale at the start
  double scale_time = 1e9;         // s over which it forgets, back to its standard deviation
  double scale_walk = 0.001;
  double heading_walk = 0.0005;       // rad per square root of a second
  double position_noise = 0.02;       // m per keyframe and axis
  double heading_bias_stddev = 0.05;  // rad, of the fixes' heading, one per flight
  double fix_rate = 0.7;              // of the keyframes
  double fix_stddev = 2.5;            // m per horizontal axis, reported by the fixes
  double fix_vertical_stddev = 3.0;
  double fix_shared_stddev = 1.0;   // m per axis: not reported
  double single_wrong_rate = 0.03;  // of the fixes
  double wrong_run_rate = 0.0;      // chance at each fix that a run starts
  double wrong_run_length = 8.0;    // fixes, mean
  int wrong_at_start = 0;           // fixes of a run that the flight begins with
  double wrong_distance = 150.0;    // m, mean
  int fix_delay = 2;                // keyframes between a keyframe and its fix
  double fix_shared_vertical_stddev = 1.0;
  double fix_shared_distance = 40.0;  // m of way over which it is forgotten
  double fix_shared_vertical_distance = 40.0;
  // Of the odometry's vertical, rad: a constant part in the body's levelled axes, which is an error of the
  // accelerometer's bias that the odometry levels its attitude by, until it learns the bias all at once; and one in its
  // world, which walks, as the attitude does that gyroscopes carry. Fixes lean with both.
  Eigen::Vector2d lean = Eigen::Vector2d::Zero();
  double lean_stddev = 0.0;              // at the start, of the second one
  double lean_word = 0.007;              // rad per axis: how well the odometry says that it knows it
  double lean_walk = 0.0;                // rad per square root of a second
  double lean_learnt_at = kUnknown;      // s from the start; NaN: never
  double perspective_stddev = kUnknown;  // rad, of the tilt that fixes tell; NaN: they do not
  double compass_noise = 0.017;          // rad, white; the bias is the fixes' heading's
  bool imu = false;                      // 200 Hz samples, of biases that the odometry knows to 0.02 m/s^2 and the lean
};

struct SyntheticFlight {
  struct Step {  // in the order of arrival
    enum class Kind { kState, kKeyframe, kFix, kCompass, kImu } kind = Kind::kState;
    size_t index = 0;
  };
  std::vector<OdometryState> states;        // 10 Hz
  std::vector<Eigen::Vector3d> truth;       // p_G_B at each state
  std::vector<Eigen::Quaterniond> truth_q;  // q_G_B at each state
  std::vector<Keyframe> keyframes;
  std::vector<Fix> fixes;
  std::vector<bool> wrong;  // of each fix
  std::vector<CompassReading> compass;
  std::vector<ImuSample> imu;
  std::vector<Step> steps;
  // s from the start at which fly() replaces the fusion by one that goes on from its memory, 0.5 s later; NaN: never.
  double fusion_killed = kUnknown;
  Geodetic anchor{47.5, 8.7, 420.0};
};

SyntheticFlight make_flight(const SyntheticOptions& options, uint64_t seed);

}  // namespace orthonav::fusion
