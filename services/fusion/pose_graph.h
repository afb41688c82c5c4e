// The graph of one segment: keyframes of one odometry session, tied to each other by the odometry and to the map by
// fixes, equations (11) to (15), and to north by the compass.
//
// Beyond the paper, each node carries what is unknown about the odometry, the compass and the fixes (node_state.h).
// The newest `window_keyframes` nodes are solved by Gauss-Newton steps from the last solution; what the older ones
// knew is kept as a Gaussian on the oldest node. On a chain that is exact up to linearisation and makes time and memory
// constant; with window_keyframes = 0 the whole trajectory is solved each time, as in the paper.
//
// Deterministic; not thread-safe.
#pragma once

#include <deque>
#include <optional>
#include <vector>

#include <Eigen/Core>

#include "services/fusion/chain.h"
#include "services/fusion/factors.h"
#include "services/fusion/node_state.h"
#include "services/fusion/options.h"
#include "services/fusion/types.h"

namespace orthonav::fusion {

// A node with its marginal covariance.
struct Estimate {
  NodeState state;
  StateMatrix covariance = StateMatrix::Zero();
};

// Height that the odometry's errors grow with, m: it sees its way in pixels.
double working_height(const EdgeOptions& edge, const Keyframe& keyframe);

// Standard deviation of a heading of which nothing is known, rad.
inline constexpr double kAnyHeading = 1.0;

// The motion between two keyframes as the graph sees it; `q_G_W` turns the odometry's covariance into G.
Transition transition_between(const FusionOptions& options, const Keyframe& from, const Keyframe& to,
                              const Eigen::Quaterniond& q_G_W);

class PoseGraph {
 public:
  explicit PoseGraph(const FusionOptions& options);

  // First node, at a guess with independent standard deviations (> 0) of each variable.
  void start(const Keyframe& keyframe, const NodeState& guess, const StateVector& stddev);
  // The same from a node as estimate() gave it, with its positive definite covariance.
  void start(const Keyframe& keyframe, const Estimate& known);
  // Next node, predicted by the odometry's motion from the newest one. Its relative covariance counts when its
  // id follows the newest node's. Ids and times must grow (std::invalid_argument).
  void append(const Keyframe& keyframe);

  // What is measured at a node; std::out_of_range without that node. Of a fix: its position under the odometry's
  // vertical, with the covariance of what it does not share with its neighbours and how it moves with the vertical; the
  // tilt of that vertical (rad, about east and north), the true heading of the body's x axis (clockwise from north) and
  // the logarithm of the odometry's scale, where it fitted them. Of the compass: its heading, declination applied.
  void add_position(int id, const Eigen::Vector3d& p_G_B, const Eigen::Matrix3d& covariance,
                    const Lever& lever = Lever::Zero());
  void add_tilt(int id, const Eigen::Vector2d& tilt, const Eigen::Matrix2d& covariance);
  void add_map_heading(int id, double heading, double stddev);
  void add_scale(int id, double log_scale, double stddev);
  void add_compass(int id, double heading, double stddev);

  // Optimises all nodes from the current state, then gives those beyond the window up to the prior.
  void solve();
  // Optimises the newest node alone: what a compass reading does to it, at a cost that does not depend on the window.
  // The others learn of it in the next solve().
  void settle_newest();

  bool contains(int id) const;
  const Keyframe& keyframe(int id) const { return at(id).keyframe; }
  const Keyframe& newest() const { return nodes_.back().keyframe; }
  const NodeState& state(int id) const { return at(id).state; }
  int size() const { return static_cast<int>(nodes_.size()); }

  // A node's state and marginal covariance. Linear in the distance to the newest node.
  Estimate estimate(int id) const;
  // The newest node as if no fix of a keyframe after `utime` had come; nullopt when that is beyond the window, so that
  // nothing can be said.
  std::optional<Estimate> without_fixes_after(int64_t utime) const;

 private:
  struct Node {
    Keyframe keyframe;
    NodeState state;
    std::optional<Prior> prior;
    std::optional<Transition> tie;                 // to the node before
    std::vector<HeadingMeasurement> headings;      // of the compass
    std::vector<HeadingMeasurement> map_headings;  // of fixes
    std::vector<ScaleMeasurement> scales;
    std::vector<PositionMeasurement> positions;
    std::vector<TiltMeasurement> tilts;
  };

  size_t index_of(int id) const;
  const Node& at(int id) const { return nodes_[index_of(id)]; }
  Node& measured(int id);  // at which something is about to be added
  Quadratic own_without_fixes(const Node& node) const;
  Quadratic own(const Node& node) const;
  PairQuadratic tie(size_t index) const;
  void relinearise_from(size_t index);
  void marginalise_beyond_window();

  FusionOptions options_;
  std::deque<Node> nodes_;
  Chain chain_;            // linearised at the nodes' states, up to
  size_t stale_from_ = 0;  // the first node that was measured since
};

}  // namespace orthonav::fusion
