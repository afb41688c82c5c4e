#include "services/registration/paper/matcher.h"

#include <cmath>
#include <stdexcept>

namespace orthonav::registration {

FlannMatcher::FlannMatcher(const cv::Mat& descriptors, const MatcherOptions& options) : options_(options) {
  if (descriptors.empty() || descriptors.type() != CV_8UC1) {
    throw std::invalid_argument("the matcher wants at least one 8-bit descriptor");
  }
  descriptors.convertTo(data_, CV_32F);
  // OpenCV's kd-trees draw from the thread's generator.
  cv::setRNGSeed(options.seed);
  index_.build(data_, cv::flann::KDTreeIndexParams(options.trees), cvflann::FLANN_DIST_L2);
}

std::vector<DescriptorMatch> FlannMatcher::match(const cv::Mat& queries) {
  if (queries.empty()) return {};
  cv::Mat wanted;
  queries.convertTo(wanted, CV_32F);
  cv::Mat indices;
  cv::Mat squared;
  index_.knnSearch(wanted, indices, squared, 1, cv::flann::SearchParams(options_.checks));
  std::vector<DescriptorMatch> matches;
  for (int i = 0; i < queries.rows; ++i) {
    const int found = indices.at<int>(i, 0);
    if (found >= 0 && found < data_.rows) matches.push_back({i, found, std::sqrt(squared.at<float>(i, 0))});
  }
  return matches;
}

}  // namespace orthonav::registration
