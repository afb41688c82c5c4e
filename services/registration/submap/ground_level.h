// How high the body is over the map's ground, told from points of which many lie above it.
//
// Each point says where the body would be if that point lay on the map's ground (its "lift"). Roofs and canopy say
// less, and over a wood they are the many: the level is not where most lifts lie but the highest one that is well
// supported, for nothing lies below the ground. Keyframes before this one, moved along by the odometry's climb, are
// remembered, because ground seen at the edge of a wood still tells the height over its middle. What the map's own
// heights err by is averaged along the way, for the odometry's climb is better than they are.
//
// A lift is as good as the scale it was made with. Levels are remembered in metres, and count the less the less their
// scale was known; where it changes by more than was said of it, it was wrong, or is, or the odometry's has changed: so
// far may be off what is remembered, and it gives way to what is seen now.
//
// Not thread-safe; a value.
#pragma once

#include <vector>

#include <Eigen/Core>

#include "services/registration/types.h"

namespace orthonav::registration {

class GroundLevel {
 public:
  // Adds the lifts (m, in G; at least one) of points seen from `height` m above them by the body at `p_W_B`, m in W;
  // `lifts_per_observation` lifts count as one. They were made with `scale`.
  void add(const std::vector<double>& lifts, double height, const Eigen::Vector3d& p_W_B, double lifts_per_observation,
           const ScaleBelief& scale = {});

  bool known() const { return !log_likelihoods_.empty(); }  // after add()

  // The body's height in G, m. Wants add() first.
  double level() const { return level_; }

  // How far above the ground a point lies, m, that lies `rise` m above the level by odometry whose body is `height` m
  // above it: what of it is more than the depth's error. Probabilities that it is on the ground, and on something.
  struct Above {
    double expected = 0, on_the_ground = 0, on_something = 0;
  };
  static Above above(double rise, double height);

  // How far below the level the ground may still lie, m, 1 sigma: where little way was flown, all that was seen may be
  // one wood.
  double hidden_stddev() const;

 private:
  double origin_ = 0;                                // m in G, of the middle of the levels compared
  Eigen::Vector3d p_W_B_ = Eigen::Vector3d::Zero();  // m, of the body that they are levels of
  ScaleBelief scale_;                                // that they were seen under, in the mean
  double way_ = 0;                                   // m, flown since the first, as far as it was seen
  std::vector<double> log_likelihoods_;              // of the levels
  double level_ = 0, averaged_ = 0;                  // m; the latter the way it is the average of
};

}  // namespace orthonav::registration
