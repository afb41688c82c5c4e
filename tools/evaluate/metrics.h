// The figures of a flight. README.md beside this file documents each as a key of report.json.
#pragma once

#include <limits>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "common/math/align.h"
#include "tools/evaluate/flight_record.h"
#include "tools/evaluate/odometry_scale.h"

namespace orthonav::evaluate {

// Position errors over a set of samples, m. NaN without samples.
struct PositionErrors {
  int samples = 0;
  double rmse = 0, horizontal_rmse = 0, vertical_rmse = 0;
  double median = 0, p95 = 0, largest = 0;  // of the 3D error

  static PositionErrors of(const std::vector<Eigen::Vector3d>& errors);
};

// Wall times, ms. NaN without samples (a replay without timings).
struct Times {
  int samples = 0;
  double median = 0, p99 = 0;

  static Times of(const std::vector<double>& ms);
};

// One error of a track, for the plots.
struct ErrorSample {
  int64_t utime = 0;
  Eigen::Vector3d p_G_B = Eigen::Vector3d::Zero();
  Eigen::Vector3d error = Eigen::Vector3d::Zero();   // m, estimate minus truth (or minus GNSS without truth)
  Eigen::Vector3d stddev = Eigen::Vector3d::Zero();  // m, reported; NaN: unknown
  double heading_error = 0;                          // rad; NaN: unknown
  double heading_stddev = 0;                         // rad; NaN: unknown
};

struct VioMetrics {
  PositionErrors truth;     // after Umeyama alignment with scale, each session by itself
  PositionErrors yaw_only;  // after alignment in yaw and translation
  PositionErrors gnss;      // as `truth`, against the GNSS reference
  double scale = 0;         // true size over the odometry's, of the longest session
  // Of the odometry's first stretch, the first one from 30 s later on, and the last; none where it did not move.
  std::optional<ScaleError> scale_at_start, scale_after_30s, scale_at_end;
  double heading_rmse = 0;    // rad, after alignment in yaw and translation
  double drift_per_100m = 0;  // m, median over all stretches of 100 m
  int restarts = 0;
  double tracking_share = 0;  // of the images from the first tracked one on
  Times time;
  std::vector<ErrorSample> track;  // aligned with scale
};

// What became of one registration.
struct JudgedFix {
  const map_fix_t* fix = nullptr;
  std::optional<Eigen::Vector3d> p_G_B;       // of a valid fix
  std::optional<Eigen::Vector2d> implied_en;  // position that the best translation implies
  std::optional<ReferenceSample> reference;
  bool true_match = false;  // at least 8 inliers and the implied position within 30 m of the reference
  bool false_fix = false;   // valid and more than 30 m from the reference
};

// A cause fitted alone to the fixes' errors.
struct ExplainedError {
  double slope = std::numeric_limits<double>::quiet_NaN();
  double left = std::numeric_limits<double>::quiet_NaN();  // m, root mean square per axis, that it does not explain
};

// error_regression.h says of what model. NaN with fewer than 10 fixes.
struct ErrorRegression {
  int fixes = 0;
  double horizontal = std::numeric_limits<double>::quiet_NaN();  // m, root mean square per axis, of the errors
  ExplainedError tilt_height;                                    // slope 1: a fix leans as the odometry does
  ExplainedError heading;  // slope: m to the left of the course per rad, clockwise
  ExplainedError scale;    // slope: m along the course per unit of scale
  Eigen::Vector2d offset_en = Eigen::Vector2d::Constant(std::numeric_limits<double>::quiet_NaN());  // m, constant
  double offset_left = std::numeric_limits<double>::quiet_NaN();
  Eigen::VectorXd together;  // slopes of tilt, heading, scale, and the offset east and north, fitted at once
  double together_left = std::numeric_limits<double>::quiet_NaN();
  double vertical = std::numeric_limits<double>::quiet_NaN();  // m, root mean square
  ExplainedError scale_height;
  ExplainedError vertical_offset;  // slope: m
  double vertical_together_left = std::numeric_limits<double>::quiet_NaN();
};

struct RegistrationMetrics {
  PositionErrors truth;          // of the valid fixes
  PositionErrors truth_correct;  // of those within 30 m
  PositionErrors gnss;
  PositionErrors to_map;    // against the truth as the map shows it: without the map's own error
  double heading_rmse = 0;  // rad, of the valid fixes within 30 m
  int tried = 0, valid = 0, true_matches = 0, false_fixes = 0;
  double true_match_rate = 0;
  double inliers_median = 0;  // of the true matches
  Times time, describe, match, solve;
  std::vector<JudgedFix> fixes;
  ErrorRegression regression;
};

// Means of the squared error weighted by the inverse of the reported covariance, per degree of freedom.
struct Consistency {
  double position = 0, horizontal = 0, velocity = 0, attitude = 0;
  double pose = 0;  // position and attitude together
};

// Errors against the protection levels, over the epochs with a position and a truth.
struct ProtectionStatistics {
  int epochs = 0;
  int bounded = 0;                                                // with both levels
  double bounded_share = 0;                                       // of the images
  int misleading_horizontal = 0, misleading_vertical = 0;         // error beyond its level
  double horizontal_median = 0, vertical_median = 0;              // m, of the levels
  double largest_horizontal_part = 0, largest_vertical_part = 0;  // error over level
};

// A stretch, after the first position, in which the map did not aid the solution.
struct Outage {
  double begin = 0;             // s since the first measurement
  double duration = 0;          // s until the map aided it again, or the end of the log
  double without_position = 0;  // s of it
  double largest_error = 0;     // m, horizontal, until it was back
  bool ended = false;           // it came back
};

// The states between the images.
struct InertialRate {
  PositionErrors errors;
  double rate_hz = 0;
};

struct FusionMetrics {
  PositionErrors truth;  // from the first geodetic position on
  PositionErrors gnss;
  PositionErrors to_map;
  double heading_rmse = 0;   // rad
  double velocity_rmse = 0;  // m/s, against the truth's change of position
  Consistency nees;          // 1 when the covariance is honest
  ProtectionStatistics protection;
  std::vector<Outage> outages;
  InertialRate inertial;
  double within_3_sigma = 0;     // share of samples whose horizontal error is below 3 reported standard deviations
  double time_to_first_fix = 0;  // s from the first tracked odometry state
  double time_to_first_fix_from_start = 0;  // s from the first measurement
  double coasting_share = 0;                // of the time after the first fix
  double located_share = 0;                 // of the images
  int resets = 0;
  Times time;
  std::vector<ErrorSample> track;
};

struct TransportMetrics {
  std::optional<Times> latency;  // image to NAV_STATE, by the logger's clock; none in a replay
  int images_without_vio = 0;    // between the first and the last VIO_STATE
  int vio_without_nav = 0;
  int keyframe_gaps = 0;  // ids missing within a session
  int keyframes_without_fix_message = 0;
  int64_t undecodable = 0;
};

struct Metrics {
  bool has_truth = false;
  bool has_gnss = false;
  double duration = 0;   // s
  double distance = 0;   // m along the reference
  double mean_tilt = 0;  // rad, of the true attitude; NaN without truth
  VioMetrics vio;
  RegistrationMetrics registration;
  FusionMetrics fusion;
  TransportMetrics transport;
  std::vector<std::string> notes;  // what is missing in the log, and what follows from it
};

Metrics evaluate(const FlightRecord& record);

// Horizontal position in the record's frame that a fix's best translation (8) implies, valid or not: the keyframe
// turned by the heading and shifted ("submap", "paper"), or what the image's centre lies on, stepped back along the
// optical axis
// ("m1", "m2"). nullopt when the message does not say.
std::optional<Eigen::Vector2d> implied_position(const map_fix_t& fix, const vio_keyframe_t& keyframe);

}  // namespace orthonav::evaluate
