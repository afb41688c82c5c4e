// Alignment of two point sequences, for evaluation and for calibration of simulated data.
#pragma once

#include <vector>

#include <Eigen/Core>

namespace orthonav {

// x_to = scale * R * x_from + t
struct Similarity {
  double scale = 1.0;
  Eigen::Matrix3d R = Eigen::Matrix3d::Identity();
  Eigen::Vector3d t = Eigen::Vector3d::Zero();

  Eigen::Vector3d operator*(const Eigen::Vector3d& x) const { return scale * (R * x) + t; }
};

// Least-squares similarity, S. Umeyama, PAMI 1991; with `with_scale` false, the rigid motion.
// Throws std::invalid_argument unless there are at least 3 pairs of equal number.
Similarity align_umeyama(const std::vector<Eigen::Vector3d>& from, const std::vector<Eigen::Vector3d>& to,
                         bool with_scale);

// Least-squares rotation about z and translation: what a gravity-aligned odometry cannot know.
// Throws as align_umeyama does (2 pairs suffice).
Similarity align_yaw_translation(const std::vector<Eigen::Vector3d>& from, const std::vector<Eigen::Vector3d>& to);

}  // namespace orthonav
