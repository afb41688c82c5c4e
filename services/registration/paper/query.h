// Turns a keyframe into a query of the map: equations (5) and (6).
#pragma once

#include <string>
#include <vector>

#include <Eigen/Core>
#include <opencv2/core.hpp>

#include "common/camera/camera_model.h"
#include "services/registration/image_similarity.h"
#include "services/registration/types.h"

namespace orthonav::registration {

// One queried feature, Q_k of equation (6).
struct QueryPoint {
  int index = -1;         // in Keyframe::points; -1: a point of the detector
  Eigen::Vector2d ray;    // undistorted image coordinates at z = 1
  Eigen::Vector2d pixel;  // in the turned and scaled image
};

struct Query {
  std::string refused;  // why the keyframe cannot be registered; empty when it can
  Eigen::Matrix3d R_G_W = Eigen::Matrix3d::Identity();
  ImageSimilarity similarity;
  std::vector<QueryPoint> points;
  cv::Mat descriptors;  // CV_8U, one row of 128 per point
};

// Describes a keyframe. `image` is the raw grey image of its time. With map.keypoint_size 0 the SIFT detector chooses
// the points. Bad input (NaN, height <= 0, wrong image size, too few points) gives a refusal, never an exception.
Query make_query(const Keyframe& keyframe, const cv::Mat& image, const CameraModel& camera, double true_heading,
                 const MapGeometry& map, const QueryOptions& options);

}  // namespace orthonav::registration
