// What registration works on, free of any message type.
#pragma once

#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <opencv2/core.hpp>

#include "common/camera/camera_model.h"

namespace orthonav::registration {

// A corner tracked by the odometry, with the point (2) it gives it.
struct TrackedPoint {
  int64_t id = -1;
  Eigen::Vector2d pixel = Eigen::Vector2d::Zero();   // raw image, pixels
  Eigen::Vector3d ray_C = Eigen::Vector3d::UnitZ();  // undistorted, z = 1
  Eigen::Vector3d p_W = Eigen::Vector3d::Zero();     // m
  double reprojection_error = 0;                     // pixels
};

struct Keyframe {
  int id = 0;  // counts from 0 within the session
  Eigen::Vector3d p_W_B = Eigen::Vector3d::Zero();
  Eigen::Quaterniond q_W_B = Eigen::Quaterniond::Identity();
  Extrinsics extrinsics;
  double height_above_ground = 0;                                  // m
  double scale_stddev = std::numeric_limits<double>::quiet_NaN();  // of the odometry, relative; NaN: unknown
  std::vector<TrackedPoint> points;
};

// What is known of the odometry's scale: of the logarithm of true displacement over the odometry's.
struct ScaleBelief {
  double log_scale = 0;
  double stddev = 0;
};

// Two that know nothing of each other, as one.
inline ScaleBelief both(const ScaleBelief& a, const ScaleBelief& b) {
  const double of_a = 1 / (a.stddev * a.stddev), of_b = 1 / (b.stddev * b.stddev);
  return {(of_a * a.log_scale + of_b * b.log_scale) / (of_a + of_b), 1 / std::sqrt(of_a + of_b)};
}

// Whether two such can be of one scale.
inline bool agree(const ScaleBelief& a, const ScaleBelief& b) {
  return std::abs(a.log_scale - b.log_scale) <= 3 * std::hypot(a.stddev, b.stddev);
}

// True heading of the body's x axis, clockwise from true north.
struct Heading {
  double value = 0;      // rad
  double stddev = M_PI;  // rad; half a turn and more: nothing is known

  bool known() const { return stddev < M_PI; }
};

// The map's features: l_j of equation (3) in G and their descriptors.
struct MapFeatures {
  std::vector<Eigen::Vector3f> positions;  // m
  cv::Mat descriptors;                     // CV_8U, one row of 128 per position
};

// What of the map the query must know.
struct MapGeometry {
  double metres_per_pixel = 0;  // sigma
  double keypoint_size = 0;     // map pixels; 0: the detector's own
  double keypoint_stride = 0;   // map pixels; 0: the detector's own
};

}  // namespace orthonav::registration
