// Looks for what an estimator cannot survive and a configuration easily gets wrong: the units and axes of the IMU and
// the rotation between camera and IMU.
//
// The camera alone tells how it turned between two images (epipolar geometry, which holds on a plane too); the
// gyroscope and the configured extrinsics tell the same. A linear map A between the two rotation vectors,
//   w_camera = A w_gyroscope + c T,
// is fitted to all pairs of images with c the gyroscope's bias: A is the identity when all is well, a rotation when
// the extrinsics are off, a multiple of a rotation when the gyroscope's units are wrong, anything else when its axes
// are. The accelerometer's mean must be as large as gravity. Nothing is said until turns have made it certain: on a
// straight leg nothing can be known, and nothing is lost by it either. Knows no state of the estimator: it works
// before a start, which a wrong calibration may prevent. Not thread-safe; deterministic.
#pragma once

#include <cstdint>
#include <map>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "common/camera/camera_model.h"
#include "services/vio/state.h"

namespace orthonav::vio {

struct CalibrationCheckOptions {
  double max_rotation_deg = 4.0;    // degrees, of a wrong camera-IMU rotation before it is reported
  double significance = 5.0;        // standard deviations, before anything is
  double max_gravity_error = 0.15;  // of the accelerometer's mean, relative
};

// Rotation and direction of translation between two images from bearings alone.
struct RelativeRotation {
  Eigen::Vector3d w = Eigen::Vector3d::Zero();            // rad, R_2_1 = Exp(w)
  Eigen::Matrix3d information = Eigen::Matrix3d::Zero();  // of w, per rad^2
  double residual = 0;                                    // pixels from the epipolar lines, root mean square
};

// Minimises the distances to the epipolar lines, robustly, from several first guesses. A plane allows two motions
// (translation and normal change places): of those that fit as well as the best, the one next to `expected` is taken.
//   rays_1, rays_2  bearings with z = 1, of equal number, at least 12
//   expected        rotation vector that another sensor tells, rad
//   focal, pixel_sigma  pixels
RelativeRotation relative_rotation(const std::vector<Eigen::Vector3d>& rays_1,
                                   const std::vector<Eigen::Vector3d>& rays_2, const Eigen::Vector3d& expected,
                                   double focal, double pixel_sigma);

class CalibrationCheck {
 public:
  CalibrationCheck(const CalibrationCheckOptions& options, const Extrinsics& extrinsics, double gravity, double focal);

  // One frame: its features, and the IMU samples since the previous frame, both ends included.
  void add(const std::vector<TrackedFeature>& features, const std::vector<ImuSample>& imu);

  // What is wrong, in words for the pilot; empty while nothing is known to be.
  const std::string& complaint() const { return complaint_; }

 private:
  void add_pair(const std::map<int64_t, Eigen::Vector3d>& now);
  void check_gravity(const std::vector<ImuSample>& imu);
  void check_rotation();

  CalibrationCheckOptions options_;
  Extrinsics extrinsics_;
  double gravity_, focal_;

  std::map<int64_t, Eigen::Vector3d> reference_;                // bearings of the pair's first image
  Eigen::Quaterniond turned_ = Eigen::Quaterniond::Identity();  // R_first_now in B, by the gyroscope
  double elapsed_ = 0;                                          // s
  int pairs_ = 0;
  Eigen::Vector3d bias_ = Eigen::Vector3d::Zero();  // rad/s, c as far as known
  // Normal equations of (A - I by rows, c), and of (turn, c): the same pairs, fewer unknowns.
  Eigen::Matrix<double, 12, 12> H_ = Eigen::Matrix<double, 12, 12>::Zero();
  Eigen::Matrix<double, 12, 1> b_ = Eigen::Matrix<double, 12, 1>::Zero();
  Eigen::Matrix<double, 6, 6> H_turn_ = Eigen::Matrix<double, 6, 6>::Zero();
  Eigen::Matrix<double, 6, 1> b_turn_ = Eigen::Matrix<double, 6, 1>::Zero();
  double squares_ = 0;  // of the rotation vectors' differences, weighted: the cost of A = I, c = 0
  double force_sum_ = 0, force_time_ = 0;
  std::string complaint_, gravity_complaint_;
};

}  // namespace orthonav::vio
