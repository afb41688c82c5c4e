// The translation most matches agree on: equation (8) and the rule after it.
#pragma once

#include <vector>

#include <Eigen/Core>

namespace orthonav::registration {

struct VotingOptions {
  double inlier_radius = 9;     // m
  double second_distance = 30;  // m: candidates further than this from the best are another place
};

struct VotingResult {
  std::vector<int> inliers;  // indices of the votes within the radius of the winner, ascending; empty without votes
  Eigen::Vector2d translation = Eigen::Vector2d::Zero();  // m, mean of the inliers
  int winner = -1;
  int num_second = 0;  // inliers of the best candidate more than second_distance from the translation
};

// Exact: counts for every vote the votes within the radius, itself included; the first of the best wins. Sorted by
// east, so that only votes within the radius in east are compared: O(n log n + pairs).
VotingResult vote(const std::vector<Eigen::Vector2d>& votes, const VotingOptions& options);

}  // namespace orthonav::registration
