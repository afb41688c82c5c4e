// Nearest map descriptors by FLANN, as in the paper: kd-trees searched approximately.
#pragma once

#include <memory>
#include <vector>

#include <opencv2/core.hpp>
#include <opencv2/flann.hpp>

namespace orthonav::registration {

struct MatcherOptions {
  int trees = 4;    // randomised kd-trees
  int checks = 32;  // leaves looked at per query
  int seed = 1;     // of the trees: the same seed gives the same matches
};

struct DescriptorMatch {
  int query = -1;      // row of the query
  int map = -1;        // row of the map
  float distance = 0;  // Euclidean
};

class FlannMatcher {
 public:
  // Builds the trees over CV_8U descriptors, one per row; at least one. The data is held as floats (4 bytes a
  // component). Sets OpenCV's random seed. Throws std::invalid_argument for no or other data.
  FlannMatcher(const cv::Mat& descriptors, const MatcherOptions& options);

  // The nearest found map row of each query row (CV_8U), in the queries' order. Not thread-safe.
  std::vector<DescriptorMatch> match(const cv::Mat& queries);

 private:
  MatcherOptions options_;
  cv::Mat data_;
  cv::flann::Index index_;
};

}  // namespace orthonav::registration
