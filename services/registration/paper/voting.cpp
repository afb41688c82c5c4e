#include "services/registration/paper/voting.h"

#include <algorithm>
#include <numeric>

namespace orthonav::registration {

VotingResult vote(const std::vector<Eigen::Vector2d>& votes, const VotingOptions& options) {
  VotingResult result;
  if (votes.empty()) return result;
  std::vector<int> order(votes.size());
  std::iota(order.begin(), order.end(), 0);
  std::stable_sort(order.begin(), order.end(),
                   [&](int a, int b) { return votes[static_cast<size_t>(a)].x() < votes[static_cast<size_t>(b)].x(); });
  const double radius = options.inlier_radius;
  std::vector<int> count(votes.size(), 1);
  for (size_t i = 0; i < order.size(); ++i) {
    const Eigen::Vector2d& a = votes[static_cast<size_t>(order[i])];
    for (size_t k = i + 1; k < order.size(); ++k) {
      const Eigen::Vector2d& b = votes[static_cast<size_t>(order[k])];
      if (b.x() - a.x() > radius) break;
      if ((b - a).squaredNorm() > radius * radius) continue;
      ++count[static_cast<size_t>(order[i])];
      ++count[static_cast<size_t>(order[k])];
    }
  }
  result.winner = static_cast<int>(std::max_element(count.begin(), count.end()) - count.begin());
  const Eigen::Vector2d& best = votes[static_cast<size_t>(result.winner)];
  Eigen::Vector2d sum = Eigen::Vector2d::Zero();
  for (size_t i = 0; i < votes.size(); ++i) {
    if ((votes[i] - best).squaredNorm() > radius * radius) continue;
    result.inliers.push_back(static_cast<int>(i));
    sum += votes[i];
  }
  result.translation = sum / static_cast<double>(result.inliers.size());
  for (size_t i = 0; i < votes.size(); ++i) {
    if ((votes[i] - result.translation).norm() > options.second_distance) {
      result.num_second = std::max(result.num_second, count[i]);
    }
  }
  return result;
}

}  // namespace orthonav::registration
