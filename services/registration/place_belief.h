// Where on the map the aircraft may be: places held side by side, each with its odds, until one is sure.
//
// A hypothesis is where the odometry's W lies in G, told by the place of the newest body and how W is turned and
// scaled. The odometry carries it from keyframe to keyframe; with each its log-odds become what all that is remembered
// of the ground says for it against ground of no relation. One more hypothesis always stands: "none of these", against
// which odds are stated, for the aircraft may be off the map, the map may have changed, the camera may see nothing
// known. So the probability of a place is its odds over those of all places and none.
//
// Knows neither messages nor descriptors. Not thread-safe; values.
#pragma once

#include <cstdint>
#include <utility>
#include <vector>

#include <Eigen/Core>

namespace orthonav::registration {

struct PlaceHypothesis {
  int64_t id = 0;
  Eigen::Vector2d en = Eigen::Vector2d::Zero();       // m in G, of the newest body
  Eigen::Matrix2d G_W = Eigen::Matrix2d::Identity();  // takes horizontal offsets in W to G, scale included
  double stddev = 0;                                  // m on each axis
  double log_odds = 0;                                // against none
};

class PlaceBelief {
 public:
  void clear();

  // To the newest keyframe, whose body is at `p_W` (m, horizontally in W). Directions and lengths of ways are known to
  // `way_stddev`, relative.
  void carry(const Eigen::Vector2d& p_W, double way_stddev);

  // A place (en, m in G, known to `stddev` m) that has these odds: the hypothesis that it agrees with, or else a new
  // one.
  void suppose(const Eigen::Vector2d& en, const Eigen::Matrix2d& G_W, double stddev, double log_odds);

  // The body of the hypothesis was found at `en`, known to `stddev` m.
  void correct(int64_t id, const Eigen::Vector2d& en, const Eigen::Matrix2d& G_W, double stddev);

  // After all that a keyframe had to say: those that have come to agree are one, and those that are negligible are
  // dropped.
  void settle();

  // The likeliest first after settle().
  const std::vector<PlaceHypothesis>& hypotheses() const { return hypotheses_; }
  const PlaceHypothesis* find(int64_t id) const;
  // The likeliest of those that a place agrees with; null: none does.
  const PlaceHypothesis* agreeing(const Eigen::Vector2d& en, double stddev) const;
  // Log-odds of it against all others and none; minus infinity of one that is not there.
  double log_odds(int64_t id) const;
  double probability(int64_t id) const;
  // The log-odds of the place `en`, known to `stddev` m; of one that nobody considers, what is negligible.
  double log_odds_at(const Eigen::Vector2d& en, double stddev) const;
  // That it is none of them.
  double none() const;

 private:
  PlaceHypothesis* find(int64_t id);
  // Logarithm of the sum of the odds of all others than `id` and of none, 1.
  double log_others(int64_t id) const;

  std::vector<PlaceHypothesis> hypotheses_;
  Eigen::Vector2d p_W_ = Eigen::Vector2d::Zero();
  int64_t newest_ = 0;
};

}  // namespace orthonav::registration
