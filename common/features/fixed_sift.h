// SIFT descriptors at given points, with a fixed orientation and a fixed size.
//
// A nadir image turned by its heading and scaled to the map differs from the map by a translation only, so neither a
// detector's orientation nor its scale is wanted: fixing both makes the descriptor of a tracked corner comparable to
// that of any map pixel. The map's database (equation 3) and the query (equation 6) are both described by this class,
// with the same size, or they do not match.
#pragma once

#include <vector>

#include <opencv2/core.hpp>
#include <opencv2/features2d.hpp>

namespace orthonav {

inline constexpr int kSiftBytes = 128;

class FixedSift {
 public:
  // `keypoint_size` in pixels is the diameter OpenCV gives a keypoint: the descriptor's 4 x 4 cells, 1.5 sizes wide
  // each, cover a square 6 sizes wide. Throws std::invalid_argument unless it is in [2, 128].
  explicit FixedSift(double keypoint_size);

  // Descriptors of a CV_8U image at points (u right, v down, pixel centres at integers): CV_8U, one row of 128 per
  // point, in their order. Samples outside the image are left out of a descriptor; a patch without any gradient
  // gives a row of zeros. Throws std::invalid_argument for another image type or an empty image.
  cv::Mat describe(const cv::Mat& grey, const std::vector<cv::Point2f>& points) const;

  double keypoint_size() const { return keypoint_size_; }

  // Half the width of the square of pixels a descriptor depends on, the Gaussian smoothing included.
  int support() const;

 private:
  double keypoint_size_;
  cv::Ptr<cv::SIFT> sift_;
};

// SIFT with keypoints, orientations and sizes from its own detector (comparison method M2).
// Points as above; descriptors CV_8U, one row of 128 per point, in the detector's (deterministic) order.
struct DetectedSift {
  std::vector<cv::Point2f> points;
  cv::Mat descriptors;
};
DetectedSift detect_sift(const cv::Mat& grey);

}  // namespace orthonav
