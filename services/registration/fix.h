// The outcome of registering a keyframe, by whatever method.
#pragma once

#include <cstdint>
#include <limits>
#include <string>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>

namespace orthonav::registration {

// A pair of a fix, for inspection.
struct Pair {
  int64_t feature_id = -1;                           // of the tracked point, -1: a point of the detector
  Eigen::Vector2d pixel = Eigen::Vector2d::Zero();   // raw image
  Eigen::Vector2d map_en = Eigen::Vector2d::Zero();  // m in G
  double residual = 0;                               // m
};

inline constexpr double kUnknown = std::numeric_limits<double>::quiet_NaN();

// How a fix depends on the vertical, as in map_fix_t: what it is under the odometry's, and what the ground alone says
// of that. NaN: unknown. In G; tilts are rotation vectors about east and north, rad.
struct Upright {
  Eigen::Vector3d p_G_B = Eigen::Vector3d::Constant(kUnknown);                          // m
  Eigen::Matrix3d covariance = Eigen::Matrix3d::Constant(kUnknown);                     // m^2
  Eigen::Matrix<double, 3, 2> lever = Eigen::Matrix<double, 3, 2>::Constant(kUnknown);  // m/rad
  Eigen::Vector2d tilt = Eigen::Vector2d::Constant(kUnknown);
  Eigen::Matrix2d tilt_covariance = Eigen::Matrix2d::Constant(kUnknown);  // rad^2
};

struct Fix {
  bool valid = false;
  std::string reason;                               // why not; empty when valid
  Eigen::Vector3d p_G_B = Eigen::Vector3d::Zero();  // m; meaningful when valid
  Eigen::Quaterniond q_G_B = Eigen::Quaterniond::Identity();
  Eigen::Matrix3d covariance = Eigen::Matrix3d::Zero();   // m^2, of p_G_B
  Eigen::Vector2d translation = Eigen::Vector2d::Zero();  // m: t of (8), m1 and m2: where the image's centre lies
  int num_query = 0;
  int num_candidates = 0;
  int num_inliers = 0;
  int num_second_inliers = 0;
  // As in map_fix_t; only method submap estimates them.
  double scale = kUnknown;
  double scale_stddev = kUnknown;
  double heading_correction = kUnknown;         // rad
  double heading_correction_stddev = kUnknown;  // rad
  double log_likelihood = kUnknown;
  double log_likelihood_ratio = kUnknown;
  double log_odds = kUnknown;       // of the place against all others and none
  int num_hypotheses = 0;           // places that are considered
  double search_radius = kUnknown;  // m
  int num_keyframes = 1;
  int num_contradicted = 0;  // points of the keyframe whose depth contradicts its height (method submap)
  Upright upright;           // only method submap
  std::vector<Pair> pairs;   // inliers, also of a refused fix
};

}  // namespace orthonav::registration
