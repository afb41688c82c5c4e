// The pose graph of one segment: keyframes of one odometry session, tied to each other by the odometry and to the
// map by fixes. Equations (11) to (15).
//
// Beyond the paper: each node carries the odometry's scale, and "up" is tied to the odometry's, which does not drift.
// The newest `window_keyframes` nodes are optimised by Ceres from the last solution; what the older ones knew is kept
// as a Gaussian on the oldest node. On a chain that is exact up to linearisation and makes the cost per solution
// constant; with window_keyframes = 0 the whole trajectory is solved each time, as in the paper.
//
// Deterministic; not thread-safe.
#pragma once

#include <deque>
#include <memory>
#include <vector>

#include <Eigen/Core>
#include <ceres/problem.h>

#include "services/fusion/chain.h"
#include "services/fusion/factors.h"
#include "services/fusion/node_state.h"
#include "services/fusion/options.h"
#include "services/fusion/types.h"

namespace orthonav::fusion {

// The uncertainty of the motion between two keyframes `distance` metres and `duration` seconds apart, for
// (position in the first B, rotation vector in the second B).
Matrix6d edge_covariance(const EdgeOptions& options, double distance, double duration);

class PoseGraph {
 public:
  explicit PoseGraph(const FusionOptions& options);
  ~PoseGraph();

  // First node, at a guess of its pose in G.
  void start(const Keyframe& keyframe, const Eigen::Vector3d& p_G_B, const Eigen::Quaterniond& q_G_B);
  // Next node, predicted by the odometry's motion from the newest one. Its relative covariance counts when
  // its id follows the newest node's. Ids and times must grow (std::invalid_argument).
  void append(const Keyframe& keyframe);

  // Adds a fix, or a yaw (counter-clockwise from east), to a node. Throws std::out_of_range without that node.
  void add_position(int id, const Eigen::Vector3d& p_G_B, const Eigen::Matrix3d& covariance);
  void add_yaw(int id, double yaw, double stddev);

  // Optimises from the current state, then gives nodes beyond the window up to the prior.
  void solve();

  bool contains(int id) const;
  const Keyframe& keyframe(int id) const { return at(id).keyframe; }
  const Keyframe& newest() const { return nodes_.back().keyframe; }
  const NodeState& state(int id) const { return at(id).state; }
  int size() const { return static_cast<int>(nodes_.size()); }

  // Marginal covariance of a node's tangent: (position, rotation vector in G, log scale).
  TangentMatrix covariance(int id) const;

 private:
  struct Unary {
    std::unique_ptr<ceres::CostFunction> cost;
    ceres::LossFunction* loss = nullptr;  // not owned
  };
  struct Node {
    Keyframe keyframe;
    NodeState state;
    std::vector<Unary> unaries;
    std::unique_ptr<RelativeFactor> tie;  // to the node before
  };

  size_t index_of(int id) const;
  const Node& at(int id) const { return nodes_[index_of(id)]; }
  Node& at(int id) { return nodes_[index_of(id)]; }
  void add_unary(Node& node, std::unique_ptr<ceres::CostFunction> cost, ceres::LossFunction* loss);
  Quadratic linearise_unaries(const Node& node) const;
  PairQuadratic linearise_tie(const Node& before, const Node& node) const;
  void relinearise();
  void marginalise_oldest();

  FusionOptions options_;
  NodeManifold manifold_;
  std::unique_ptr<ceres::LossFunction> position_loss_;
  std::unique_ptr<ceres::LossFunction> yaw_loss_;
  std::deque<Node> nodes_;  // a deque, because Ceres holds the addresses of the states
  Chain chain_;
  std::unique_ptr<ceres::Problem> problem_;
};

}  // namespace orthonav::fusion
