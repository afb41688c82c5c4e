// Whether a keyframe can be compared with the map at all, and how its image lies on the ground: equation (5).
//
// The undistorted image is turned by its heading and scaled to the map's pixels by one similarity. The paper turns by
// the compass heading; a camera that is tilted or mounted askew needs the heading of the image's own axes on the
// ground, which follows from the compass heading, the odometry's roll and pitch and the extrinsics.
#pragma once

#include <cmath>
#include <string>

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <opencv2/core.hpp>

#include "common/camera/camera_model.h"
#include "common/config/config.h"
#include "services/registration/types.h"

namespace orthonav::registration {

struct QueryOptions {
  double max_reprojection_error = 8;  // pixels; points with more are left out
  int min_points = 20;                // a keyframe needs more than this number of points
  double max_tilt = M_PI / 4;         // rad, of the optical axis from the vertical: beyond, one similarity cannot fit

  // Reads `query` of registration.yaml. Throws ConfigError.
  static QueryOptions from_config(ConfigNode& node);
};

// The rotation about z that takes W to G, (7): so that the body's x axis has this true heading.
Eigen::Matrix3d rotation_G_W(const Eigen::Quaterniond& q_W_B, double true_heading);

// From undistorted image coordinates (x, y at z = 1) to pixels of the turned and scaled image:
//   q = scale R(angle) (x, y) + origin.
// Its pixels are sigma metres wide, u points east and v south.
struct ImageSimilarity {
  double scale = 0;                                  // pixels per unit: height / sigma
  double angle = 0;                                  // rad
  Eigen::Vector2d origin = Eigen::Vector2d::Zero();  // where the optical axis falls
  cv::Size size;                                     // of the turned image

  Eigen::Vector2d apply(const Eigen::Vector2d& xy) const;
  Eigen::Vector2d invert(const Eigen::Vector2d& pixel) const;
};

// The similarity nearest to the view of flat ground `height` below the camera, at the image's centre.
// Throws std::invalid_argument when the camera does not look down or the image would be unreasonably large or small.
ImageSimilarity view_similarity(const CameraModel& camera, const Eigen::Matrix3d& R_G_C, double height,
                                double metres_per_pixel, double max_tilt);

// Whether all numbers of a point are finite and it lies before the camera.
bool usable(const TrackedPoint& point);

// Why a keyframe or its image cannot be used at all; empty when they can.
std::string reason_to_refuse(const Keyframe& keyframe, const cv::Mat& image, const CameraModel& camera,
                             double true_heading);

}  // namespace orthonav::registration
