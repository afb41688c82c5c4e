// The front end: Shi-Tomasi corners followed by pyramidal Lucas-Kanade.
//
// Start positions come from the gyroscope's rotation, so fast turns need no large search; each track is confirmed by
// tracking back, and where the prediction loses most of them they are followed without it. Each is then aligned to its
// first sight (reference_patch.h), so that errors do not add up along a track. Outliers are found without assuming that
// the scene is not a plane (two_point.h). Tracks cover the image whatever the motion (image_grid.h): the younger of two
// that have come close ends, and new corners are taken one per cell from the cells that have no track. Where there is
// no room for more, those of a whole part of the image that has none take the place of the youngest tracks where most
// are. So the cost is bounded whatever the image shows. A single image that nearly nothing can be followed into (blur,
// a flash, a drop on the lens) is passed over, and the next one tracked from the image before it. Not thread-safe;
// deterministic.
#pragma once

#include <cstdint>
#include <map>
#include <set>
#include <vector>

#include <Eigen/Core>
#include <opencv2/core.hpp>

#include "common/camera/camera_model.h"
#include "services/vio/image_grid.h"
#include "services/vio/reference_patch.h"
#include "services/vio/state.h"

namespace orthonav::vio {

struct TrackerOptions {
  int max_features = 150;
  double corner_quality = 0.01;   // of the image's best corner
  double border = 10;             // pixels
  int search_window = 21;         // pixels, side of the patch
  int pyramid_levels = 3;         // above the full image
  double round_trip = 0.5;        // pixels: largest error of tracking forth and back
  double outlier_distance = 1.5;  // pixels from the epipolar line
};

class Tracker {
 public:
  Tracker(const CameraModel& camera, const TrackerOptions& options);

  // Tracks into `grey` (CV_8UC1 of the camera's size), and finds new corners.
  //   R_cur_prev  camera rotation between the images by the gyroscope: takes the previous camera's coordinates to
  //               the current one's
  //   rotation_trusted  false while the gyroscope's bias is unknown: outliers are then found by an essential matrix
  // Returns the features of this image, oldest first; none when it is passed over.
  const std::vector<TrackedFeature>& track(const cv::Mat& grey, const Eigen::Matrix3d& R_cur_prev,
                                           bool rotation_trusted);

  // Ends tracks that the estimator found to be wrong.
  void drop(const std::set<int64_t>& ids);

  // Forgets everything; ids go on counting.
  void reset();

 private:
  cv::Mat normalised(const cv::Mat& grey, double* gain) const;
  std::vector<TrackedFeature> follow(const std::vector<cv::Mat>& pyramid, const Eigen::Matrix3d& R_cur_prev) const;
  void align(const cv::Mat& image, const Eigen::Matrix3d& R_cur_prev);
  void reject_outliers(const std::vector<TrackedFeature>& previous, const Eigen::Matrix3d& R_cur_prev,
                       bool rotation_trusted);
  int num_gaps() const;
  void detect(const cv::Mat& image, double gain);
  void make_room(std::vector<int>& in_part);

  CameraModel camera_;
  TrackerOptions options_;
  ImageGrid cells_;  // for one track each
  ImageGrid parts_;  // of some cells each: one without a track is a gap
  std::vector<cv::Mat> pyramid_;
  std::vector<TrackedFeature> features_;  // in the image of pyramid_
  std::vector<TrackedFeature> none_;
  std::map<int64_t, ReferencePatch> references_;           // of features, by their id
  Eigen::Matrix3d R_since_ = Eigen::Matrix3d::Identity();  // since the image of pyramid_
  int passed_over_ = 0;                                    // images in a row
  int barren_ = 0;                                         // parts without a track after the last search
  int64_t next_id_ = 0;
};

}  // namespace orthonav::vio
