// A calibrated camera: where a ray in C falls in the raw image, and back.
//
// C has x right, y down, z forward. Pixel coordinates (u, v) are of the raw, distorted image, with pixel
// centres at integers. Two lens models: "radtan" (Brown-Conrady: k1 k2 p1 p2) and "equidistant"
// (Kannala-Brandt: k1 k2 k3 k4), both as in OpenCV and Kalibr. Objects are immutable after construction and
// may be used from several threads.
#pragma once

#include <array>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

namespace orthonav {

class ConfigNode;

enum class LensModel { kRadtan, kEquidistant };

struct CameraParameters {
  int width = 0;                          // pixels
  int height = 0;                         // pixels
  double fx = 0, fy = 0, cx = 0, cy = 0;  // pixels
  LensModel model = LensModel::kRadtan;
  std::array<double, 4> distortion{};  // k1 k2 p1 p2, or k1 k2 k3 k4

  // Throws std::invalid_argument naming the offending member.
  void validate() const;
};

class CameraModel {
 public:
  // Throws std::invalid_argument as CameraParameters::validate does.
  explicit CameraModel(const CameraParameters& parameters);

  // Reads `width`, `height`, `fx`, `fy`, `cx`, `cy`, `model` (radtan | equidistant), `distortion` (4 numbers).
  // Throws ConfigError with file and line.
  static CameraModel from_config(ConfigNode& node);

  const CameraParameters& parameters() const { return parameters_; }
  int width() const { return parameters_.width; }
  int height() const { return parameters_.height; }
  // Mean focal length, pixels.
  double focal() const { return 0.5 * (parameters_.fx + parameters_.fy); }

  // Pixel of a point or ray in C (any length, z > 0); nullopt behind the camera or outside the lens model's
  // range. The pixel may lie outside the image: ask contains().
  std::optional<Eigen::Vector2d> project(const Eigen::Vector3d& p_C) const;

  // Ray with z = 1 through a pixel: pi^-1 of equation (2). Newton iterations to 1e-10; nullopt where the lens
  // model cannot be inverted.
  std::optional<Eigen::Vector3d> unproject(const Eigen::Vector2d& pixel) const;

  // Whether a pixel lies in the image, at least `margin` pixels from its border.
  bool contains(const Eigen::Vector2d& pixel, double margin = 0.0) const;

 private:
  Eigen::Vector2d distort(const Eigen::Vector2d& xy, Eigen::Matrix2d* jacobian) const;

  CameraParameters parameters_;
};

// Pose of the camera in the body, T_B_C: x_B = q_B_C x_C + p_B_C.
struct Extrinsics {
  Eigen::Vector3d p_B_C = Eigen::Vector3d::Zero();
  Eigen::Matrix3d R_B_C = Eigen::Matrix3d::Identity();
  double time_offset = 0;  // s: IMU time = image time + offset

  // Reads `p_B_C` (3 numbers, m), `R_B_C` (9 numbers, row-major; must be a rotation within 1e-3) and `time_offset`.
  // Throws ConfigError with file and line.
  static Extrinsics from_config(ConfigNode& node);
};

}  // namespace orthonav
