#include "common/features/fixed_sift.h"

#include <cmath>
#include <stdexcept>

namespace orthonav {
namespace {

constexpr double kBaseSigma = 1.6;

}  // namespace

FixedSift::FixedSift(double keypoint_size)
    : keypoint_size_(keypoint_size),
      // One layer per octave: the descriptor reads the base level alone, which does not depend on how many follow.
      sift_(cv::SIFT::create(0, 1, 0.04, 10, kBaseSigma, CV_8U)) {
  if (!(keypoint_size >= 2.0 && keypoint_size <= 128.0)) {
    throw std::invalid_argument("keypoint_size must be in [2, 128] pixels");
  }
}

cv::Mat FixedSift::describe(const cv::Mat& grey, const std::vector<cv::Point2f>& points) const {
  if (grey.empty() || grey.type() != CV_8UC1) throw std::invalid_argument("FixedSift wants an 8-bit grey image");
  if (points.empty()) return cv::Mat(0, kSiftBytes, CV_8U);
  std::vector<cv::KeyPoint> keypoints;
  keypoints.reserve(points.size());
  for (const cv::Point2f& point : points) keypoints.emplace_back(point, static_cast<float>(keypoint_size_), 0.0F);
  cv::Mat descriptors;
  sift_->compute(grey, keypoints, descriptors);
  if (descriptors.rows != static_cast<int>(points.size())) throw std::logic_error("SIFT left out a given keypoint");
  return descriptors;
}

int FixedSift::support() const {
  const double cells = 0.5 * (4 + 1) * 1.5 * keypoint_size_;
  return static_cast<int>(std::ceil(cells + 4.0 * kBaseSigma)) + 2;
}

DetectedSift detect_sift(const cv::Mat& grey) {
  if (grey.empty() || grey.type() != CV_8UC1) throw std::invalid_argument("detect_sift wants an 8-bit grey image");
  std::vector<cv::KeyPoint> keypoints;
  DetectedSift result;
  cv::SIFT::create(0, 3, 0.04, 10, kBaseSigma, CV_8U)
      ->detectAndCompute(grey, cv::noArray(), keypoints, result.descriptors);
  for (const cv::KeyPoint& keypoint : keypoints) result.points.push_back(keypoint.pt);
  return result;
}

}  // namespace orthonav
