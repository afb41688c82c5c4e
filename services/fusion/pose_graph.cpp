#include "services/fusion/pose_graph.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include <Eigen/Cholesky>
#include <ceres/loss_function.h>
#include <ceres/solver.h>

namespace orthonav::fusion {
namespace {

// A compass can be wrong by more than it says, and there is one of it: beyond two standard deviations it only pulls.
constexpr double kYawHuber = 2.0;
// Standard deviation of the log scale that stands for "fixed": a hundredth of a millimetre per metre.
constexpr double kFixedScale = 1e-5;

using PaddedRows = Eigen::Matrix<double, Eigen::Dynamic, kAmbient, Eigen::RowMajor>;
using TangentRows = Eigen::Matrix<double, Eigen::Dynamic, kTangent>;

TangentRows without_padding(const PaddedRows& padded) {
  TangentRows J(padded.rows(), kTangent);
  J.leftCols<6>() = padded.leftCols<6>();
  J.col(6) = padded.col(7);
  return J;
}

ceres::Problem::Options problem_options() {
  ceres::Problem::Options options;
  options.cost_function_ownership = ceres::DO_NOT_TAKE_OWNERSHIP;
  options.loss_function_ownership = ceres::DO_NOT_TAKE_OWNERSHIP;
  options.manifold_ownership = ceres::DO_NOT_TAKE_OWNERSHIP;
  // Not enable_fast_removal: its sets are ordered by address, and so would the sums be: a replay would not repeat.
  return options;
}

double seconds_between(int64_t from, int64_t to) {
  return 1e-6 * static_cast<double>(to - from);
}

}  // namespace

Matrix6d edge_covariance(const EdgeOptions& options, double distance, double duration) {
  const double position =
      options.position_stddev * options.position_stddev + std::pow(options.position_stddev_per_metre * distance, 2);
  const double rotation = options.rotation_stddev * options.rotation_stddev +
                          options.rotation_walk * options.rotation_walk * std::max(0.0, duration);
  Matrix6d covariance = Matrix6d::Zero();
  covariance.diagonal() << position, position, position, rotation, rotation, rotation;
  return covariance;
}

PoseGraph::PoseGraph(const FusionOptions& options)
    : options_(options),
      position_loss_(std::make_unique<ceres::HuberLoss>(options.fix.huber)),
      yaw_loss_(std::make_unique<ceres::HuberLoss>(kYawHuber)),
      problem_(std::make_unique<ceres::Problem>(problem_options())) {}

PoseGraph::~PoseGraph() = default;

void PoseGraph::start(const Keyframe& keyframe, const Eigen::Vector3d& p_G_B, const Eigen::Quaterniond& q_G_B) {
  if (!nodes_.empty()) throw std::invalid_argument("PoseGraph::start: the graph has nodes already");
  nodes_.emplace_back();
  Node& node = nodes_.back();
  node.keyframe = keyframe;
  node.state = NodeState(p_G_B, q_G_B.normalized(), 0.0);
  problem_->AddParameterBlock(node.state.x.data(), kAmbient, &manifold_);
  const double scale_stddev = std::max(kFixedScale, options_.edge.scale_stddev);
  TangentMatrix scale_only = TangentMatrix::Zero();
  scale_only(6, 6) = 1.0 / scale_stddev;
  add_unary(node, std::make_unique<PriorFactor>(node.state, scale_only), nullptr);
  const Eigen::Vector3d up_B = keyframe.q_W_B.conjugate() * Eigen::Vector3d::UnitZ();
  add_unary(node, std::make_unique<TiltFactor>(up_B, options_.edge.tilt_stddev), nullptr);
  chain_.append(linearise_unaries(node));
}

void PoseGraph::append(const Keyframe& keyframe) {
  if (nodes_.empty()) throw std::invalid_argument("PoseGraph::append: the graph has not been started");
  Node& before = nodes_.back();
  const double duration = seconds_between(before.keyframe.utime, keyframe.utime);
  if (keyframe.id <= before.keyframe.id || duration <= 0.0) {
    throw std::invalid_argument("PoseGraph::append: keyframe ids and times must grow");
  }
  const Eigen::Quaterniond q_i_inverse = before.keyframe.q_W_B.conjugate();
  const Eigen::Vector3d dp = q_i_inverse * (keyframe.p_W_B - before.keyframe.p_W_B);
  const Eigen::Quaterniond dq = (q_i_inverse * keyframe.q_W_B).normalized();
  Matrix6d covariance = edge_covariance(options_.edge, dp.norm(), duration);
  if (options_.edge.use_odometry_covariance && keyframe.id == before.keyframe.id + 1 &&
      keyframe.relative_covariance.allFinite()) {
    covariance += keyframe.relative_covariance;
  }
  const double scale_stddev = std::max(kFixedScale, options_.edge.scale_walk * std::sqrt(duration));

  nodes_.emplace_back();
  Node& node = nodes_.back();
  const NodeState& from = before.state;
  node.keyframe = keyframe;
  node.state = NodeState(from.p() + from.q() * (std::exp(from.log_scale()) * dp), (from.q() * dq).normalized(),
                         from.log_scale());
  node.tie = std::make_unique<RelativeFactor>(dp, dq, covariance, scale_stddev);
  problem_->AddParameterBlock(node.state.x.data(), kAmbient, &manifold_);
  problem_->AddResidualBlock(node.tie.get(), nullptr, before.state.x.data(), node.state.x.data());
  const Eigen::Vector3d up_B = keyframe.q_W_B.conjugate() * Eigen::Vector3d::UnitZ();
  add_unary(node, std::make_unique<TiltFactor>(up_B, options_.edge.tilt_stddev), nullptr);
  chain_.append(linearise_unaries(node), linearise_tie(before, node));
}

void PoseGraph::add_position(int id, const Eigen::Vector3d& p_G_B, const Eigen::Matrix3d& covariance) {
  Node& node = at(id);
  const double height = node.keyframe.height_above_ground;
  const bool depends = options_.fix.height_from_odometry && std::isfinite(height);
  add_unary(node, std::make_unique<PositionFactor>(p_G_B, covariance, depends ? height : 0.0), position_loss_.get());
}

void PoseGraph::add_yaw(int id, double yaw, double stddev) {
  add_unary(at(id), std::make_unique<YawFactor>(yaw, stddev), yaw_loss_.get());
}

void PoseGraph::add_unary(Node& node, std::unique_ptr<ceres::CostFunction> cost, ceres::LossFunction* loss) {
  problem_->AddResidualBlock(cost.get(), loss, node.state.x.data());
  node.unaries.push_back({std::move(cost), loss});
}

void PoseGraph::solve() {
  ceres::Solver::Options options;
  options.linear_solver_type = ceres::SPARSE_NORMAL_CHOLESKY;
  options.num_threads = 1;
  options.max_num_iterations = options_.max_iterations;
  // A hundredth of a standard deviation is far below what a pilot or a later solution notices.
  options.function_tolerance = 1e-4;
  options.logging_type = ceres::SILENT;
  ceres::Solver::Summary summary;
  ceres::Solve(options, problem_.get(), &summary);
  relinearise();
  if (options_.window_keyframes > 0) {
    while (size() > options_.window_keyframes) marginalise_oldest();
  }
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

TangentMatrix PoseGraph::covariance(int id) const {
  const TangentMatrix information = chain_.information(static_cast<int>(index_of(id)));
  return information.ldlt().solve(TangentMatrix::Identity());
}

Quadratic PoseGraph::linearise_unaries(const Node& node) const {
  Quadratic sum;
  const double* block = node.state.x.data();
  for (const Unary& unary : node.unaries) {
    const int rows = unary.cost->num_residuals();
    Eigen::VectorXd r(rows);
    PaddedRows padded(rows, kAmbient);
    double* jacobian = padded.data();
    unary.cost->Evaluate(&block, r.data(), &jacobian);
    double weight = 1.0;
    if (unary.loss != nullptr) {
      double rho[3];
      unary.loss->Evaluate(r.squaredNorm(), rho);
      weight = rho[1];
    }
    const TangentRows J = without_padding(padded);
    sum.H += weight * J.transpose() * J;
    sum.b += weight * J.transpose() * r;
  }
  return sum;
}

PairQuadratic PoseGraph::linearise_tie(const Node& before, const Node& node) const {
  const double* blocks[2] = {before.state.x.data(), node.state.x.data()};
  Tangent r;
  PaddedRows padded_i(kTangent, kAmbient);
  PaddedRows padded_j(kTangent, kAmbient);
  double* jacobians[2] = {padded_i.data(), padded_j.data()};
  node.tie->Evaluate(blocks, r.data(), jacobians);
  const TangentMatrix J_i = without_padding(padded_i);
  const TangentMatrix J_j = without_padding(padded_j);
  PairQuadratic pair;
  pair.i.H = J_i.transpose() * J_i;
  pair.i.b = J_i.transpose() * r;
  pair.j.H = J_j.transpose() * J_j;
  pair.j.b = J_j.transpose() * r;
  pair.H_ij = J_i.transpose() * J_j;
  return pair;
}

void PoseGraph::relinearise() {
  chain_.clear();
  for (size_t k = 0; k < nodes_.size(); ++k) {
    const PairQuadratic tie = k == 0 ? PairQuadratic{} : linearise_tie(nodes_[k - 1], nodes_[k]);
    chain_.append(linearise_unaries(nodes_[k]), tie);
  }
}

void PoseGraph::marginalise_oldest() {
  const Quadratic left = eliminate_first(linearise_unaries(nodes_[0]), linearise_tie(nodes_[0], nodes_[1]));
  auto prior = PriorFactor::from_quadratic(nodes_[1].state, left.H, left.b);
  problem_->RemoveParameterBlock(nodes_[0].state.x.data());  // with its residuals
  nodes_.pop_front();
  nodes_[0].tie.reset();
  add_unary(nodes_[0], std::move(prior), nullptr);
  chain_.drop_oldest();
}

}  // namespace orthonav::fusion
