#include "services/fusion/pose_graph.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include <Eigen/Cholesky>

#include "common/math/so3.h"
#include "services/fusion/error_budget.h"

namespace orthonav::fusion {
namespace {

// A step that changes no node's marginal by more than this fraction of its standard deviation ends the iterations:
// far below what a pilot or a later solution notices.
constexpr double kConverged = 0.02;

double seconds_between(int64_t from, int64_t to) {
  return 1e-6 * static_cast<double>(to - from);
}

StateMatrix inverse(const StateMatrix& information) {
  return information.llt().solve(StateMatrix::Identity());
}

}  // namespace

double working_height(const EdgeOptions& edge, const Keyframe& keyframe) {
  const double height = keyframe.height_above_ground;
  return height >= 1.0 && height <= 1e5 ? height : edge.default_height;
}

Transition transition_between(const FusionOptions& options, const Keyframe& from, const Keyframe& to,
                              const Eigen::Quaterniond& q_G_W) {
  const EdgeOptions& edge = options.edge;
  const double duration = std::max(1e-3, seconds_between(from.utime, to.utime));
  Transition transition;
  transition.dp_W = to.p_W_B - from.p_W_B;
  const double way = transition.dp_W.head<2>().norm();  // over ground: who climbs sees the same map all the while
  const double walk = edge.position_walk * working_height(edge, to);
  Eigen::Matrix3d covariance = walk * walk * duration * Eigen::Matrix3d::Identity();
  double turn_variance = edge.turn_walk * edge.turn_walk * duration;
  if (edge.use_odometry_covariance && to.id == from.id + 1 && to.relative_covariance.allFinite()) {
    // The odometry's own word where it is the more modest one: its errors go on from edge to edge, which the graph
    // takes to be independent, and the figures of the configuration are those of whole stretches.
    const Eigen::Matrix3d R_G_Bi = (q_G_W * from.q_W_B).toRotationMatrix();
    const Eigen::Vector3d up_Bj = to.q_W_B.conjugate() * Eigen::Vector3d::UnitZ();
    const Eigen::Matrix3d own = R_G_Bi * to.relative_covariance.topLeftCorner<3, 3>() * R_G_Bi.transpose();
    if (own.trace() > covariance.trace()) covariance = own;
    turn_variance = std::max(turn_variance, up_Bj.dot(to.relative_covariance.bottomRightCorner<3, 3>() * up_Bj));
  }
  covariance.diagonal().array() += to.astray_variance;
  transition.position_root = sqrt_information(covariance);

  const auto forget = [&](int index, double stddev, double ratio) {
    transition.decay(index) = std::exp(-ratio);
    // At a hover nothing is forgotten; a term of the graph must still be finite.
    transition.stddev(index) = stddev * std::sqrt(std::max(1e-9, -std::expm1(-2.0 * ratio)));
  };
  // Gyroscopes carry all three axes alike.
  transition.stddev.segment<3>(kYaw).setConstant(std::sqrt(turn_variance));
  transition.stddev(kYaw) = std::sqrt(turn_variance + to.astray_turn);
  transition.lean_change = from.levelled - to.levelled;
  transition.lean_known = 1 / (std::pow(stddev_of_lean(edge, from), 2) + turn_variance);
  transition.lean_gained = std::pow(stddev_of_lean(edge, to), -2) - transition.lean_known;
  forget(kScale, edge.scale_stddev, duration / edge.scale_time);
  forget(kCompassBias, options.compass.bias_stddev, duration / options.compass.bias_time);
  const Eigen::Vector3d shared = shared_stddev(options.fix);
  for (int axis = 0; axis < 3; ++axis) {
    forget(kShared + axis, shared(axis),
           way / (axis < 2 ? options.fix.shared_distance : options.fix.shared_vertical_distance));
  }
  return transition;
}

PoseGraph::PoseGraph(const FusionOptions& options) : options_(options) {}

void PoseGraph::start(const Keyframe& keyframe, const NodeState& guess, const StateVector& stddev) {
  start(keyframe, {guess, stddev.cwiseAbs2().asDiagonal()});
}

void PoseGraph::start(const Keyframe& keyframe, const Estimate& known) {
  if (!nodes_.empty()) throw std::invalid_argument("PoseGraph::start: the graph has nodes already");
  Node& node = nodes_.emplace_back();
  node.keyframe = keyframe;
  node.state = known.state;
  node.prior.emplace();
  node.prior->point = known.state.x;
  node.prior->cost.H = inverse(known.covariance);
  relinearise_from(0);
}

void PoseGraph::append(const Keyframe& keyframe) {
  if (nodes_.empty()) throw std::invalid_argument("PoseGraph::append: the graph has not been started");
  const Node& before = nodes_.back();
  if (keyframe.id <= before.keyframe.id || keyframe.utime <= before.keyframe.utime) {
    throw std::invalid_argument("PoseGraph::append: keyframe ids and times must grow");
  }
  Node node;
  node.keyframe = keyframe;
  node.tie = transition_between(options_, before.keyframe, keyframe, before.state.q_G_W());
  node.state = predict(*node.tie, before.state);
  nodes_.push_back(std::move(node));
  relinearise_from(std::min(stale_from_, nodes_.size() - 1));
}

void PoseGraph::add_position(int id, const Eigen::Vector3d& p_G_B, const Eigen::Matrix3d& covariance,
                             const Lever& lever) {
  measured(id).positions.push_back({p_G_B, sqrt_information(covariance), lever});
}

void PoseGraph::add_tilt(int id, const Eigen::Vector2d& tilt, const Eigen::Matrix2d& covariance) {
  measured(id).tilts.push_back({tilt, sqrt_information(covariance)});
}

void PoseGraph::add_map_heading(int id, double heading, double stddev) {
  Node& node = measured(id);
  node.map_headings.push_back({heading, stddev, false, node.keyframe.q_W_B * Eigen::Vector3d::UnitX()});
}

void PoseGraph::add_scale(int id, double log_scale, double stddev) {
  measured(id).scales.push_back({log_scale, stddev});
}

void PoseGraph::add_compass(int id, double heading, double stddev) {
  Node& node = measured(id);
  node.headings.push_back({heading, stddev, true, node.keyframe.q_W_B * Eigen::Vector3d::UnitX()});
}

PoseGraph::Node& PoseGraph::measured(int id) {
  const size_t index = index_of(id);
  stale_from_ = std::min(stale_from_, index);
  return nodes_[index];
}

void PoseGraph::solve() {
  for (int iteration = 0; iteration < options_.max_iterations; ++iteration) {
    relinearise_from(stale_from_);
    const std::vector<StateVector> change = chain_.solve();
    for (size_t k = 0; k < nodes_.size(); ++k) nodes_[k].state.x += change[k];
    const StateVector newest_stddev = inverse(chain_.newest().H).diagonal().cwiseSqrt();
    stale_from_ = 0;
    if (change.back().cwiseQuotient(newest_stddev).cwiseAbs().maxCoeff() < kConverged) break;
  }
  relinearise_from(0);
  marginalise_beyond_window();
}

void PoseGraph::settle_newest() {
  relinearise_from(stale_from_);
  const Quadratic newest = chain_.newest();
  nodes_.back().state.x -= newest.H.llt().solve(newest.b);
  relinearise_from(nodes_.size() - 1);
  marginalise_beyond_window();
}

bool PoseGraph::contains(int id) const {
  const auto found = std::lower_bound(nodes_.begin(), nodes_.end(), id,
                                      [](const Node& node, int wanted) { return node.keyframe.id < wanted; });
  return found != nodes_.end() && found->keyframe.id == id;
}

size_t PoseGraph::index_of(int id) const {
  const auto found = std::lower_bound(nodes_.begin(), nodes_.end(), id,
                                      [](const Node& node, int wanted) { return node.keyframe.id < wanted; });
  if (found == nodes_.end() || found->keyframe.id != id) throw std::out_of_range("PoseGraph: no such keyframe");
  return static_cast<size_t>(found - nodes_.begin());
}

Estimate PoseGraph::estimate(int id) const {
  const size_t index = index_of(id);
  return {nodes_[index].state, inverse(chain_.information(static_cast<int>(index)))};
}

std::optional<Estimate> PoseGraph::without_fixes_after(int64_t utime) const {
  size_t first = nodes_.size();
  while (first > 0 && nodes_[first - 1].keyframe.utime > utime) --first;
  if (first == 0) return std::nullopt;
  // Up to the node before, the chain's own forward sweep holds.
  Quadratic before = chain_.forward(static_cast<int>(first) - 1);
  before += own(nodes_[first - 1]);
  for (size_t k = first; k < nodes_.size(); ++k) {
    before = eliminate_first(before, tie(k)).left;
    before += own_without_fixes(nodes_[k]);
  }
  Estimate result{nodes_.back().state, inverse(before.H)};
  result.state.x -= result.covariance * before.b;
  return result;
}

Quadratic PoseGraph::own_without_fixes(const Node& node) const {
  Quadratic sum;
  if (node.prior) sum += linearise(*node.prior, node.state);
  for (const HeadingMeasurement& heading : node.headings) sum += linearise(heading, node.state, options_.compass.huber);
  return sum;
}

Quadratic PoseGraph::own(const Node& node) const {
  Quadratic sum = own_without_fixes(node);
  for (const HeadingMeasurement& heading : node.map_headings) {
    sum += linearise(heading, node.state, options_.compass.huber);
  }
  for (const ScaleMeasurement& scale : node.scales) sum += linearise(scale, node.state, options_.fix.huber);
  for (const PositionMeasurement& position : node.positions) sum += linearise(position, node.state, options_.fix.huber);
  for (const TiltMeasurement& tilt : node.tilts) sum += linearise(tilt, node.state, options_.fix.huber);
  return sum;
}

PairQuadratic PoseGraph::tie(size_t index) const {
  return linearise(*nodes_[index].tie, nodes_[index - 1].state, nodes_[index].state);
}

void PoseGraph::relinearise_from(size_t index) {
  chain_.truncate(static_cast<int>(index));
  for (size_t k = index; k < nodes_.size(); ++k) {
    chain_.append(own(nodes_[k]), k == 0 ? PairQuadratic() : tie(k));
  }
  stale_from_ = nodes_.size();
}

void PoseGraph::marginalise_beyond_window() {
  while (options_.window_keyframes > 0 && size() > options_.window_keyframes) {
    Node& heir = nodes_[1];
    heir.prior = Prior{heir.state.x, chain_.forward(1)};
    heir.tie.reset();
    nodes_.pop_front();
    chain_.drop_oldest();
    --stale_from_;
  }
}

}  // namespace orthonav::fusion
