// What goes into the fusion and what comes out, free of any transport.
//
// Frames: W is the odometry's world (gravity-aligned, arbitrary yaw and origin, one per session), G the geodetic
// east-north-up frame at the map's anchor, B the body.
#pragma once

#include <cstdint>
#include <limits>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "common/geo/enu_frame.h"

namespace orthonav::fusion {

using Matrix6d = Eigen::Matrix<double, 6, 6>;

inline constexpr double kUnknown = std::numeric_limits<double>::quiet_NaN();

// The odometry's newest pose.
struct OdometryState {
  int64_t utime = 0;      // microseconds since the Unix epoch
  int session = 0;        // of the odometry
  bool has_pose = false;  // false while the odometry initialises
  Eigen::Vector3d p_W_B = Eigen::Vector3d::Zero();
  Eigen::Quaterniond q_W_B = Eigen::Quaterniond::Identity();
  Eigen::Vector3d v_W_B = Eigen::Vector3d::Zero();  // m/s; NaN: unknown
};

// A keyframe of the odometry: one node of the graph.
struct Keyframe {
  int64_t utime = 0;
  int session = 0;
  int id = 0;  // counts from 0 within the session
  Eigen::Vector3d p_W_B = Eigen::Vector3d::Zero();
  Eigen::Quaterniond q_W_B = Eigen::Quaterniond::Identity();
  double height_above_ground = kUnknown;  // m, of B over the tracked points; NaN: unknown
  // Of the pose relative to keyframe id - 1: (position in the previous B, rotation vector in this B); NaN: unknown.
  Matrix6d relative_covariance = Matrix6d::Constant(kUnknown);
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
};

enum class Mode : int8_t {
  kWaitingForVio = 0,
  kDeadReckoning = 1,  // odometry without a fix: poses are in W
  kMapAided = 2,
  kCoasting = 3,  // no fix for longer than the configured time
};

// Where the aircraft is, for one odometry state. Before the first fix of a segment p, v and q are in W, and
// geodetic, anchor, covariance and time_since_fix are NaN.
struct Solution {
  int64_t utime = 0;
  Mode mode = Mode::kWaitingForVio;
  int session = 0;
  Geodetic position{kUnknown, kUnknown, kUnknown};
  Geodetic anchor{kUnknown, kUnknown, kUnknown};
  Eigen::Vector3d p_G_B = Eigen::Vector3d::Constant(kUnknown);
  Eigen::Vector3d v_G_B = Eigen::Vector3d::Constant(kUnknown);
  Eigen::Quaterniond q_G_B{kUnknown, kUnknown, kUnknown, kUnknown};
  Matrix6d covariance = Matrix6d::Constant(kUnknown);  // (position, rotation vector in G: R = Exp(e) R_hat)
  double time_since_fix = kUnknown;                    // s
  int num_fixes = 0;                                   // in use in this segment
  int reset_counter = 0;                               // grows whenever the position jumps other than by moving
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
  kJump,             // the odometry moved faster than any aircraft of this kind
};

const char* to_string(Outcome outcome);

}  // namespace orthonav::fusion
