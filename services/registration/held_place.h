// Over how much new ground one keyframe after another was found at the same place, carried along by the odometry.
//
// A submap that is found at a wrong place looks like it somewhere, and goes on being found there for as long as it
// remembers that ground; a right place is found again from ground that it has never seen. So where no keyframe's own
// evidence is enough, having held over as much ground as a submap remembers says what its likelihood does not: over
// another flight's map one keyframe in 800 is at such a place, over its own two in three (docs/registration.md).
//
// Not thread-safe; a value.
#pragma once

#include <vector>

#include <Eigen/Core>

namespace orthonav::registration {

class HeldPlace {
 public:
  // A keyframe with its body at `p_W` (m, horizontally in W) was found at `en` (m in G), where `G_W` takes horizontal
  // offsets in W to G, scale included. It is the place that is held if it lies within `tolerance` (m) of where that has
  // moved to; one keyframe may lie elsewhere (not_found() counts as such), at the second in a row another place begins.
  // Ground is new that lies at least `spacing` (m) from all that was seen from the place so far.
  void found(const Eigen::Vector2d& p_W, const Eigen::Vector2d& en, const Eigen::Matrix2d& G_W, double tolerance,
             double spacing);
  void not_found() { ++elsewhere_; }

  // How many times new ground was seen from where the newest keyframe was found; 0 where the place is another one.
  int new_ground() const { return elsewhere_ == 0 ? static_cast<int>(seen_.size()) : 0; }

 private:
  std::vector<Eigen::Vector2d> seen_;  // m in W, the body over ground that was new; the first is where the place began
  Eigen::Vector2d p_W_ = Eigen::Vector2d::Zero();  // m, of the keyframe found last
  Eigen::Vector2d en_ = Eigen::Vector2d::Zero();   // m, of the place then
  Eigen::Matrix2d G_W_ = Eigen::Matrix2d::Identity();
  int elsewhere_ = 0;  // keyframes since
};

}  // namespace orthonav::registration
