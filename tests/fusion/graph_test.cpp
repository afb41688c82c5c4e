// The pose graph against dense algebra and against its own whole-trajectory form.
#include <random>

#include <gtest/gtest.h>

#include "common/geo/enu_frame.h"
#include "services/fusion/pose_graph.h"
#include "tests/fusion/synthetic_flight.h"

namespace orthonav::fusion {
namespace {

TEST(Chain, MarginalsEqualThoseOfTheDenseInverse) {
  constexpr int kNodes = 5;
  Eigen::MatrixXd dense = Eigen::MatrixXd::Zero(kNodes * kTangent, kNodes * kTangent);
  Chain chain;
  std::mt19937 engine(1);
  auto random = [&] {
    TangentMatrix m;
    for (int i = 0; i < 49; ++i) m.data()[i] = static_cast<double>(engine() % 2001) / 1000.0 - 1.0;
    return m;
  };
  for (int k = 0; k < kNodes; ++k) {
    Quadratic own;
    if (k == 1 || k == 3) {
      const TangentMatrix root = random();
      own.H = root * root.transpose();
    }
    PairQuadratic tie;
    dense.block<7, 7>(7 * k, 7 * k) += own.H;
    if (k > 0) {
      const TangentMatrix J_i = random() + 3.0 * TangentMatrix::Identity();
      const TangentMatrix J_j = random() + 3.0 * TangentMatrix::Identity();
      tie.i.H = J_i.transpose() * J_i;
      tie.j.H = J_j.transpose() * J_j;
      tie.H_ij = J_i.transpose() * J_j;
      dense.block<7, 7>(7 * (k - 1), 7 * (k - 1)) += tie.i.H;
      dense.block<7, 7>(7 * k, 7 * k) += tie.j.H;
      dense.block<7, 7>(7 * (k - 1), 7 * k) += tie.H_ij;
      dense.block<7, 7>(7 * k, 7 * (k - 1)) += tie.H_ij.transpose();
    }
    chain.append(own, tie);
  }
  const Eigen::MatrixXd covariance = dense.inverse();
  for (int k = 0; k < kNodes; ++k) {
    const TangentMatrix expected = covariance.block<7, 7>(7 * k, 7 * k);
    const TangentMatrix marginal = chain.information(k).inverse();
    EXPECT_LT((marginal - expected).norm(), 1e-6 * expected.norm()) << "node " << k;
  }
  chain.drop_oldest();
  chain.drop_oldest();
  const TangentMatrix expected = covariance.block<7, 7>(7 * 4, 7 * 4);
  EXPECT_LT((chain.information(2).inverse() - expected).norm(), 1e-6 * expected.norm());
}

struct Driven {
  PoseGraph graph;
  explicit Driven(const FusionOptions& options) : graph(options) {}
  void drive(const SyntheticFlight& flight, size_t count) {
    const EnuFrame frame(flight.anchor);
    const Keyframe& first = flight.keyframes[0];
    const Eigen::Quaterniond q_G_W = flight.truth_q[0] * first.q_W_B.conjugate();
    graph.start(first, flight.truth[0], q_G_W * first.q_W_B);
    size_t next_fix = 0;
    for (size_t k = 0; k < count; ++k) {
      if (k > 0) graph.append(flight.keyframes[k]);
      if (next_fix < flight.fixes.size() && flight.fixes[next_fix].keyframe_id == static_cast<int>(k)) {
        const Fix& fix = flight.fixes[next_fix++];
        graph.add_position(fix.keyframe_id, frame.to_enu(fix.position), fix.covariance);
        graph.solve();
      }
    }
    graph.solve();
  }
};

SyntheticOptions clean() {
  SyntheticOptions options;
  options.duration = 120.0;
  options.single_wrong_rate = 0.0;
  return options;
}

TEST(PoseGraph, WindowGivesTheSameAsTheWholeTrajectory) {
  const SyntheticFlight flight = make_flight(clean(), 3);
  FusionOptions whole;
  whole.window_keyframes = 0;
  whole.max_iterations = 20;
  FusionOptions window = whole;
  window.window_keyframes = 60;
  Driven a(whole), b(window);
  a.drive(flight, flight.keyframes.size());
  b.drive(flight, flight.keyframes.size());
  ASSERT_EQ(b.graph.size(), 60);
  ASSERT_EQ(a.graph.size(), static_cast<int>(flight.keyframes.size()));
  const int newest = flight.keyframes.back().id;
  const Tangent difference = a.graph.state(newest).minus(b.graph.state(newest));
  const Tangent stddev = a.graph.covariance(newest).diagonal().cwiseSqrt();
  // What the linearisation point of the marginalised nodes costs: a small part of the uncertainty.
  for (int k = 0; k < kTangent; ++k) EXPECT_LT(std::abs(difference(k)), 0.1 * stddev(k)) << k;
  const Tangent stddev_window = b.graph.covariance(newest).diagonal().cwiseSqrt();
  for (int k = 0; k < kTangent; ++k) EXPECT_NEAR(stddev_window(k) / stddev(k), 1.0, 0.02) << k;
}

TEST(PoseGraph, NoiseFreeOdometryAndFixesGiveTheTruthAndTheScale) {
  SyntheticOptions options = clean();
  options.position_noise = options.heading_walk = options.scale_walk = 0.0;
  options.fix_shared_stddev = 0.0;
  options.fix_stddev = options.fix_vertical_stddev = 1e-6;
  SyntheticFlight flight = make_flight(options, 5);
  for (Fix& fix : flight.fixes) fix.covariance = Eigen::Matrix3d::Identity();
  FusionOptions fusion;
  fusion.window_keyframes = 0;
  fusion.max_iterations = 50;
  fusion.edge.scale_stddev = 10.0;  // no pull towards a scale of 1
  Driven driven(fusion);
  driven.drive(flight, 300);
  const Keyframe& newest = driven.graph.newest();
  const size_t state = 3 * static_cast<size_t>(newest.id);
  EXPECT_LT((driven.graph.state(newest.id).p() - flight.truth[state]).norm(), 0.01);
  const double odometry = (flight.states[state].p_W_B - flight.states[0].p_W_B).norm();
  const double truth = (flight.truth[state] - flight.truth[0]).norm();
  EXPECT_NEAR(std::exp(driven.graph.state(newest.id).log_scale()), truth / odometry, 1e-3);
}

TEST(PoseGraph, RefusesKeyframesThatGoBack) {
  const SyntheticFlight flight = make_flight(clean(), 1);
  PoseGraph graph{FusionOptions{}};
  EXPECT_THROW(graph.append(flight.keyframes[0]), std::invalid_argument);
  graph.start(flight.keyframes[5], Eigen::Vector3d::Zero(), Eigen::Quaterniond::Identity());
  EXPECT_THROW(graph.append(flight.keyframes[5]), std::invalid_argument);
  EXPECT_THROW(graph.append(flight.keyframes[4]), std::invalid_argument);
  EXPECT_THROW(graph.add_position(4, Eigen::Vector3d::Zero(), Eigen::Matrix3d::Identity()), std::out_of_range);
}

}  // namespace
}  // namespace orthonav::fusion
