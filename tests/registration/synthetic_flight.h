// A textured flat ground, its map, and keyframes of a camera over it, for tests of registration.
#pragma once

#include <random>

#include <opencv2/imgproc.hpp>

#include "common/features/fixed_sift.h"
#include "common/features/orientation_field.h"
#include "common/math/so3.h"
#include "services/registration/types.h"
#include "tests/support/texture.h"

namespace orthonav::registration {

inline CameraModel test_camera() {
  CameraParameters parameters;
  parameters.width = 320;
  parameters.height = 240;
  parameters.fx = parameters.fy = 400;
  parameters.cx = 161.5;
  parameters.cy = 118.2;
  parameters.distortion = {-0.11, 0.09, 0.0003, -0.0002};
  return CameraModel(parameters);
}

struct Capture {
  Keyframe keyframe;
  cv::Mat image;
  Heading heading;        // true one
  Eigen::Vector3d p_G_B;  // true ones
  Eigen::Quaterniond q_G_B;
};

template <class Ground>
class GroundOf {
 public:
  static constexpr double kSigma = 0.3;
  // Corner of the map at the origin of G.
  explicit GroundOf(unsigned seed, int pixels = 600) : texture_(seed), pixels_(pixels) {}

  const Ground& texture() const { return texture_; }

  MapFeatures grid_features(double keypoint_size) const {
    MapFeatures features;
    std::vector<cv::Point2f> points;
    for (int v = 5; v < pixels_; v += 10) {
      for (int u = 5; u < pixels_; u += 10) points.emplace_back(static_cast<float>(u), static_cast<float>(v));
    }
    features.descriptors = FixedSift(keypoint_size).describe(picture(), points);
    place(points, features);
    return features;
  }

  MapFeatures detected_features() const {
    DetectedSift detected = detect_sift(picture());
    MapFeatures features;
    features.descriptors = detected.descriptors;
    place(detected.points, features);
    return features;
  }

  // What a body at p_G_B with this heading, pitch and roll (rad) sees and what its odometry knows: W is G turned and
  // moved. `scale_error` is the odometry's.
  Capture capture(const Eigen::Vector3d& p_G_B, double heading, double pitch, double roll,
                  double scale_error = 1) const {
    const CameraModel camera = test_camera();
    Capture capture;
    capture.heading = {heading, 0.05};
    capture.p_G_B = p_G_B;
    capture.q_G_B = Eigen::AngleAxisd(M_PI / 2 - heading, Eigen::Vector3d::UnitZ()) *
                    Eigen::AngleAxisd(pitch, Eigen::Vector3d::UnitY()) *
                    Eigen::AngleAxisd(roll, Eigen::Vector3d::UnitX());
    Keyframe& keyframe = capture.keyframe;
    keyframe.extrinsics.R_B_C << 0, -1, 0, -1, 0, 0, 0, 0, -1;
    keyframe.extrinsics.p_B_C = {0.1, 0.02, -0.05};
    const Eigen::Matrix3d R_G_C = capture.q_G_B.toRotationMatrix() * keyframe.extrinsics.R_B_C;
    const Eigen::Vector3d p_G_C = p_G_B + capture.q_G_B * keyframe.extrinsics.p_B_C;
    const auto ground = [&](const Eigen::Vector2d& pixel) -> Eigen::Vector3d {
      const Eigen::Vector3d ray = R_G_C * camera.unproject(pixel).value();
      return p_G_C - p_G_C.z() / ray.z() * ray;
    };
    capture.image = texture_.picture(
        {camera.width(), camera.height()},
        [&](const Eigen::Vector2d& pixel) -> Eigen::Vector2d { return ground(pixel).template head<2>(); });

    const Eigen::Matrix3d R_W_G = Eigen::AngleAxisd(0.7, Eigen::Vector3d::UnitZ()).toRotationMatrix();
    const Eigen::Vector3d p_W_G(40, -25, 3);
    const auto to_W = [&](const Eigen::Vector3d& p_G) -> Eigen::Vector3d {
      return scale_error * (R_W_G * (p_G - p_G_B)) + R_W_G * p_G_B + p_W_G;
    };
    keyframe.p_W_B = to_W(p_G_B);
    keyframe.q_W_B = Eigen::Quaterniond(R_W_G) * capture.q_G_B;
    keyframe.height_above_ground = scale_error * p_G_B.z();
    std::vector<cv::Point2f> corners;
    cv::goodFeaturesToTrack(capture.image, corners, 80, 0.01, 12);
    for (size_t i = 0; i < corners.size(); ++i) {
      TrackedPoint point;
      point.id = static_cast<int64_t>(100 + i);
      point.pixel = {corners[i].x, corners[i].y};
      point.ray_C = camera.unproject(point.pixel).value();
      point.p_W = to_W(ground(point.pixel));
      point.reprojection_error = 0.5;
      keyframe.points.push_back(point);
    }
    return capture;
  }

  // The map, pixel (i, j) at ((i + 0.5) sigma, -(j + 0.5) sigma).
  cv::Mat picture() const {
    return texture_.picture({pixels_, pixels_}, [](const Eigen::Vector2d& pixel) {
      return Eigen::Vector2d((pixel.x() + 0.5) * kSigma, -(pixel.y() + 0.5) * kSigma);
    });
  }

 private:
  static void place(const std::vector<cv::Point2f>& points, MapFeatures& features) {
    for (const cv::Point2f& point : points) {
      features.positions.emplace_back(static_cast<float>((point.x + 0.5) * kSigma),
                                      static_cast<float>(-(point.y + 0.5) * kSigma), 0.0F);
    }
  }

  Ground texture_;
  int pixels_;
};

using SyntheticGround = GroundOf<test::Texture>;
using SyntheticFields = GroundOf<test::Patchwork>;

inline const MapGeometry kFieldsMap{SyntheticFields::kSigma, 12, 10};

// The map of `ground` as the map server describes it for method "submap".
inline MapFeatures described_map(const SyntheticFields& ground) {
  MapFeatures features = ground.grid_features(12);
  std::vector<cv::Point2f> points;
  for (const Eigen::Vector3f& p : features.positions) {
    points.emplace_back(p.x() / 0.3F - 0.5F, -p.y() / 0.3F - 0.5F);
  }
  features.descriptors = OrientationField(ground.picture(), {.keypoint_size = 12}).describe(points);
  return features;
}

}  // namespace orthonav::registration
