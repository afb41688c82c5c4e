#include "services/registration/paper/voting.h"

#include <random>

#include <gtest/gtest.h>

namespace orthonav::registration {
namespace {

TEST(Voting, FindsTheClusterAmongScatterAndItsMean) {
  std::vector<Eigen::Vector2d> votes;
  std::mt19937 random(5);
  std::uniform_real_distribution<double> anywhere(-700, 700);
  for (int i = 0; i < 100; ++i) votes.emplace_back(anywhere(random), anywhere(random));
  Eigen::Vector2d mean = Eigen::Vector2d::Zero();
  for (int i = 0; i < 16; ++i) {
    votes.emplace_back(2000 + 4 * std::cos(i), -300 + 4 * std::sin(i));
    mean += votes.back() / 16;
  }
  const VotingResult result = vote(votes, {});
  EXPECT_EQ(result.inliers.size(), 16u);
  EXPECT_EQ(result.inliers.front(), 100);
  EXPECT_NEAR((result.translation - mean).norm(), 0, 1e-12);
}

TEST(Voting, CountsTheBestOtherPlace) {
  std::vector<Eigen::Vector2d> votes;
  for (int i = 0; i < 9; ++i) votes.emplace_back(i * 0.1, 0);
  for (int i = 0; i < 7; ++i) votes.emplace_back(500 + i * 0.1, 0);
  for (int i = 0; i < 8; ++i) votes.emplace_back(25 + i * 0.1, 0);  // not another place, only a blur of the best
  const VotingResult result = vote(votes, {});
  EXPECT_EQ(result.inliers.size(), 9u);
  EXPECT_EQ(result.num_second, 7);
}

TEST(Voting, IsExact) {
  std::mt19937 random(1);
  std::normal_distribution<double> normal(0, 12);
  for (int round = 0; round < 50; ++round) {
    std::vector<Eigen::Vector2d> votes;
    for (int i = 0; i < 60; ++i) votes.emplace_back(normal(random), normal(random));
    size_t best = 0;
    for (const auto& a : votes) {
      size_t count = 0;
      for (const auto& b : votes) count += (a - b).norm() <= 9 ? 1 : 0;
      best = std::max(best, count);
    }
    EXPECT_EQ(vote(votes, {}).inliers.size(), best);
  }
}

TEST(Voting, OfNothingIsNothing) {
  const VotingResult result = vote({}, {});
  EXPECT_TRUE(result.inliers.empty());
  EXPECT_EQ(result.num_second, 0);
}

}  // namespace
}  // namespace orthonav::registration
