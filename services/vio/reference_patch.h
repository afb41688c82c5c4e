// A feature's looks when it was first seen, to which later sights of it are aligned.
//
// Lucas-Kanade from image to image adds its errors up: over the 50-100 images of a track they walk off by 0.1-0.3
// pixels, the same way for as long as the track lasts, which the estimator takes for motion; it then doubts the
// gyroscope instead (measured: lag-one correlation of the residuals 0.96-0.99, the vertical 0.3-0.5 degrees off where
// white noise leaves 0.1). Aligned to the first sight, the error of one image is not that of the next.
//
// The patch is turned as the gyroscope says the camera turned since, which is all the warp that a camera moving over
// the ground needs, and compared with its mean and contrast taken out. Translation only, inverse compositional (Baker
// and Matthews, "Lucas-Kanade 20 years on", IJCV 2004). A value; not thread-safe.
#pragma once

#include <array>
#include <optional>

#include <Eigen/Core>
#include <opencv2/core.hpp>

#include "common/camera/camera_model.h"

namespace orthonav::vio {

class ReferencePatch {
 public:
  // Of what `image` (CV_8UC1) shows around `pixel`; nullopt where the patch crosses the border, has too little texture
  // to be aligned to, or the lens cannot be inverted.
  static std::optional<ReferencePatch> make(const cv::Mat& image, const Eigen::Vector2d& pixel,
                                            const CameraModel& camera);

  // The camera has turned: `R_cur_prev` takes the previous coordinates in C to the current ones.
  void turn(const Eigen::Matrix3d& R_cur_prev) { R_cur_ref_ = R_cur_prev * R_cur_ref_; }

  enum class Result {
    kAligned,      // `pixel` was moved to where `image` shows the patch
    kUnlike,       // the image shows something else there by now: the patch is of no use any more
    kAtTheBorder,  // not all of it is in the image
  };
  // `pixel` is where the patch is in `image` to about a pixel, `ray` (z = 1) the ray through it.
  Result align(const cv::Mat& image, const CameraModel& camera, const Eigen::Vector3d& ray,
               Eigen::Vector2d& pixel) const;

 private:
  static constexpr int kHalf = 7;  // pixels on either side of the middle
  static constexpr int kSide = 2 * kHalf + 1;
  static constexpr size_t kSamples = kSide * kSide;

  std::array<float, kSamples> values_{};                     // grey levels less their mean
  std::array<float, kSamples> gradient_u_{}, gradient_v_{};  // per pixel of the reference, less their mean
  float contrast_ = 0;                                       // length of values_
  Eigen::Matrix2d inverse_hessian_ = Eigen::Matrix2d::Identity();
  Eigen::Matrix2d ray_per_pixel_ = Eigen::Matrix2d::Identity();  // of the ray's x and y at the reference
  Eigen::Matrix3d R_cur_ref_ = Eigen::Matrix3d::Identity();
};

}  // namespace orthonav::vio
