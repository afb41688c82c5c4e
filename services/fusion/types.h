// What goes into the fusion and what comes out, free of any transport.
//
// Frames: W is the odometry's world (gravity-aligned, arbitrary yaw and origin, one per session), G the geodetic
// east-north-up frame at the map's anchor, B the body.
#pragma once

#include <cstdint>
#include <limits>
#include <optional>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "common/geo/enu_frame.h"

namespace orthonav::fusion {

using Matrix6d = Eigen::Matrix<double, 6, 6>;

inline constexpr double kUnknown = std::numeric_limits<double>::quiet_NaN();

// The odometry's newest pose.
struct OdometryState {
  int64_t utime = 0;       // microseconds since the Unix epoch
  int session = 0;         // of the odometry
  bool has_pose = false;   // false while the odometry initialises
  bool has_tracks = true;  // false: of what the frame before saw nothing was seen again
  Eigen::Vector3d p_W_B = Eigen::Vector3d::Zero();
  Eigen::Quaterniond q_W_B = Eigen::Quaterniond::Identity();
  Eigen::Vector3d v_W_B = Eigen::Vector3d::Zero();       // m/s; NaN: unknown
  Eigen::Vector3d gyro_bias = Eigen::Vector3d::Zero();   // rad/s, in B
  Eigen::Vector3d accel_bias = Eigen::Vector3d::Zero();  // m/s^2, in B
  Eigen::Vector2d levelled = Eigen::Vector2d::Zero();    // rad, as in vio_state_t
  double lean_stddev = kUnknown;                         // rad per axis, of W's "up" by its own word; NaN: unknown
};

// A keyframe of the odometry: one node of the graph.
struct Keyframe {
  int64_t utime = 0;
  int session = 0;
  int id = 0;  // counts from 0 within the session
  Eigen::Vector3d p_W_B = Eigen::Vector3d::Zero();
  Eigen::Quaterniond q_W_B = Eigen::Quaterniond::Identity();
  double height_above_ground = kUnknown;               // m, of B over the tracked points; NaN: unknown
  Eigen::Vector2d levelled = Eigen::Vector2d::Zero();  // rad, as in vio_keyframe_t
  double lean_stddev = kUnknown;  // rad per axis, of W's "up" by the odometry's own word by then; NaN: unknown
  double astray_variance = 0.0;   // m^2 per axis: by which the way from the keyframe before may be another one,
  double astray_turn = 0.0;       // rad^2: and its heading
  // Of the pose relative to keyframe id - 1: (position in the previous B, rotation vector in this B); NaN: unknown.
  Matrix6d relative_covariance = Matrix6d::Constant(kUnknown);
};

// How a fix depends on the vertical that it was found under: what it would be under the odometry's own, and what the
// lie of the ground says of that. All in G; tilts are rotation vectors about east and north, rad.
struct Upright {
  Eigen::Vector3d p_G_B = Eigen::Vector3d::Zero();       // m, less the fix's position
  Eigen::Matrix3d covariance = Eigen::Matrix3d::Zero();  // m^2, of the matches alone
  Eigen::Matrix<double, 3, 2> lever =
      Eigen::Matrix<double, 3, 2>::Zero();         // m/rad: p_G_B is off by this times the true tilt
  Eigen::Vector2d tilt = Eigen::Vector2d::Zero();  // R_G_B = Exp(tilt) R_odometry, by the ground alone
  Eigen::Matrix2d tilt_covariance = Eigen::Matrix2d::Zero();
};

// The position of a keyframe found on the map.
struct Fix {
  int64_t utime = 0;
  int session = 0;
  int keyframe_id = 0;
  Geodetic position;                                                 // of B
  Geodetic anchor;                                                   // origin of the map's G
  Eigen::Matrix3d covariance = Eigen::Matrix3d::Constant(kUnknown);  // m^2, east north up; NaN: unknown
  double heading = kUnknown;         // rad, true heading of B's x axis, clockwise from north; required
  double heading_stddev = kUnknown;  // rad; NaN: unknown
  bool heading_fitted = false;       // to the map, with heading_stddev; else it is the compass's
  double scale = kUnknown;           // true displacement over the odometry's, fitted to the map; NaN: it was not
  double scale_stddev = kUnknown;
  double log_odds = kUnknown;  // that this is the place, as in map_fix_t; NaN: it does not say
  int num_keyframes = 1;       // whose points it matched: so many neighbouring fixes share most of their evidence
  std::optional<Upright> upright;
};

// A reading of the compass.
struct CompassReading {
  int64_t utime = 0;
  double heading = kUnknown;         // rad, magnetic, of B's x axis, clockwise; NaN: unknown
  double heading_stddev = kUnknown;  // rad; NaN: unknown
};

// A sample of the inertial sensor, in B.
struct ImuSample {
  int64_t utime = 0;
  Eigen::Vector3d angular_rate = Eigen::Vector3d::Zero();    // rad/s
  Eigen::Vector3d specific_force = Eigen::Vector3d::Zero();  // m/s^2
};

// What the output is worth; mode.h has the transitions between them.
enum class Mode : int8_t {
  kWaitingForVio = 0,
  kDeadReckoning = 1,  // odometry, and never a position yet: poses are in W
  kMapAided = 2,
  kCoasting = 3,    // no fix for longer than the configured time: the covariance grows
  kLost = 4,        // there was a position, and it is gone, contradicted or too uncertain
  kReacquired = 5,  // map-aided again, for the first seconds after being lost or after a move to another place
};

// Where the aircraft is. Without a position on the map p, v and q are in W, and geodetic, anchor, covariances,
// protection levels and time_since_fix are NaN.
struct Solution {
  int64_t utime = 0;
  Mode mode = Mode::kWaitingForVio;
  int session = 0;
  bool inertial = false;  // propagated by the inertial sensor; false: at an odometry state
  Geodetic position{kUnknown, kUnknown, kUnknown};
  Geodetic anchor{kUnknown, kUnknown, kUnknown};
  Eigen::Vector3d p_G_B = Eigen::Vector3d::Constant(kUnknown);
  Eigen::Vector3d v_G_B = Eigen::Vector3d::Constant(kUnknown);
  Eigen::Quaterniond q_G_B{kUnknown, kUnknown, kUnknown, kUnknown};
  Matrix6d covariance = Matrix6d::Constant(kUnknown);  // (position, rotation vector in G: R = Exp(e) R_hat)
  Eigen::Matrix3d velocity_covariance = Eigen::Matrix3d::Constant(kUnknown);  // m^2/s^2
  double horizontal_protection_level = kUnknown;                              // m, protection.h
  double vertical_protection_level = kUnknown;                                // m
  double scale = kUnknown;                                                    // true displacement over the odometry's
  double heading_offset = kUnknown;                                           // rad, of W in G, counter-clockwise
  double compass_bias = kUnknown;     // rad, the compass's heading minus the true one
  double vertical_offset = kUnknown;  // m, by which the fixes here are too high
  double time_since_fix = kUnknown;   // s
  int num_fixes = 0;                  // in use in this segment
  int reset_counter = 0;              // grows whenever the position jumps other than by moving

  bool located() const { return position.latitude_deg == position.latitude_deg; }
};

// What became of an input.
enum class Outcome {
  kUsed,             // in the graph
  kWaiting,          // kept until other fixes confirm it
  kLocked,           // with this fix the segment found its place on the map
  kRelocked,         // with this fix the segment moved to another place on the map
  kOutlier,          // disagrees with the solution; remembered, in case the others were wrong
  kBadNumber,        // NaN, infinite, or outside any plausible range
  kUnknownKeyframe,  // the keyframe never came
  kTooLate,          // the keyframe has left the graph
  kOldSession,       // of a session that is over
  kDuplicate,        // that keyframe, or a fix of it, is already here
  kOutOfOrder,       // not newer than the one before
  kJump,             // the odometry moved faster than any aircraft of this kind
};

const char* to_string(Outcome outcome);

}  // namespace orthonav::fusion
