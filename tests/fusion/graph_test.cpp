// The graph against dense algebra and against its own whole-trajectory form.
#include <random>

#include <gtest/gtest.h>

#include "common/geo/enu_frame.h"
#include "common/math/so3.h"
#include "services/fusion/pose_graph.h"
#include "tests/fusion/synthetic_flight.h"

namespace orthonav::fusion {
namespace {

TEST(Chain, SolvesAndMarginalisesAsTheDenseSystemDoes) {
  constexpr int kNodes = 5;
  constexpr int N = kStates;
  Eigen::MatrixXd H = Eigen::MatrixXd::Zero(kNodes * N, kNodes * N);
  Eigen::VectorXd b = Eigen::VectorXd::Zero(kNodes * N);
  Chain chain;
  std::mt19937 engine(1);
  auto random = [&](auto matrix) {
    for (int i = 0; i < matrix.size(); ++i) matrix.data()[i] = static_cast<double>(engine() % 2001) / 1000.0 - 1.0;
    return matrix;
  };
  for (int k = 0; k < kNodes; ++k) {
    Quadratic own;
    if (k != 2) {
      const StateMatrix root = random(StateMatrix());
      own.H = root * root.transpose() + 0.1 * StateMatrix::Identity();
      own.b = random(StateVector());
    }
    PairQuadratic tie;
    H.block<N, N>(N * k, N * k) += own.H;
    b.segment<N>(N * k) += own.b;
    if (k > 0) {
      const StateMatrix J_i = random(StateMatrix()) + 3.0 * StateMatrix::Identity();
      const StateMatrix J_j = random(StateMatrix()) + 3.0 * StateMatrix::Identity();
      const StateVector r = random(StateVector());
      tie = {{J_i.transpose() * J_i, J_i.transpose() * r},
             {J_j.transpose() * J_j, J_j.transpose() * r},
             J_i.transpose() * J_j};
      H.block<N, N>(N * (k - 1), N * (k - 1)) += tie.i.H;
      H.block<N, N>(N * k, N * k) += tie.j.H;
      H.block<N, N>(N * (k - 1), N * k) += tie.H_ij;
      H.block<N, N>(N * k, N * (k - 1)) += tie.H_ij.transpose();
      b.segment<N>(N * (k - 1)) += tie.i.b;
      b.segment<N>(N * k) += tie.j.b;
    }
    chain.append(own, tie);
  }
  const Eigen::MatrixXd covariance = H.inverse();
  const Eigen::VectorXd minimum = -covariance * b;
  const std::vector<StateVector> change = chain.solve();
  for (int k = 0; k < kNodes; ++k) {
    const StateMatrix expected = covariance.block<N, N>(N * k, N * k);
    EXPECT_LT((chain.information(k).inverse() - expected).norm(), 1e-6 * expected.norm()) << "node " << k;
    EXPECT_LT((change[static_cast<size_t>(k)] - minimum.segment<N>(N * k)).norm(), 1e-6 * minimum.norm());
  }
  chain.drop_oldest();
  chain.drop_oldest();
  const StateMatrix expected = covariance.block<N, N>(N * 4, N * 4);
  EXPECT_LT((chain.information(2).inverse() - expected).norm(), 1e-6 * expected.norm());
  EXPECT_LT((chain.solve().back() - minimum.tail<N>()).norm(), 1e-6 * minimum.norm());
}

StateVector wide() {
  StateVector stddev;
  stddev << 1e4, 1e4, 1e4, 1.0, 0.005, 0.005, 0.02, 0.09, 1.5, 1.5, 2.0;
  return stddev;
}

struct Driven {
  PoseGraph graph;
  explicit Driven(const FusionOptions& options) : graph(options) {}
  // `blind_after`: no fix of a later keyframe is added.
  void drive(const SyntheticFlight& flight, size_t count, const StateVector& stddev = wide(),
             int blind_after = 1'000'000) {
    const EnuFrame frame(flight.anchor);
    const Keyframe& first = flight.keyframes[0];
    NodeState guess;
    guess.x.head<3>() = flight.truth[0];
    guess.x(kYaw) = Eigen::AngleAxisd(flight.truth_q[0] * first.q_W_B.conjugate()).angle() *
                    Eigen::AngleAxisd(flight.truth_q[0] * first.q_W_B.conjugate()).axis().z();
    graph.start(first, guess, stddev);
    size_t next_fix = 0;
    for (size_t k = 0; k < count; ++k) {
      if (k > 0) graph.append(flight.keyframes[k]);
      if (next_fix < flight.fixes.size() && flight.fixes[next_fix].keyframe_id == static_cast<int>(k)) {
        const Fix& fix = flight.fixes[next_fix++];
        if (fix.keyframe_id > blind_after) continue;
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
  const Estimate of_whole = a.graph.estimate(newest), of_window = b.graph.estimate(newest);
  const StateVector stddev = of_whole.covariance.diagonal().cwiseSqrt();
  const StateVector difference = of_whole.state.x - of_window.state.x;
  // What the linearisation point of the marginalised nodes costs: a small part of the uncertainty.
  for (int k = 0; k < kStates; ++k) EXPECT_LT(std::abs(difference(k)), 0.1 * stddev(k)) << k;
  const StateVector stddev_window = of_window.covariance.diagonal().cwiseSqrt();
  for (int k = 0; k < kStates; ++k) EXPECT_NEAR(stddev_window(k) / stddev(k), 1.0, 0.02) << k;
}

TEST(PoseGraph, NoiseFreeOdometryAndFixesGiveTheTruthAndTheScale) {
  SyntheticOptions options = clean();
  options.position_noise = options.heading_walk = options.scale_walk = 0.0;
  options.fix_shared_stddev = options.fix_shared_vertical_stddev = 0.0;
  options.fix_stddev = options.fix_vertical_stddev = 1e-6;
  SyntheticFlight flight = make_flight(options, 5);
  for (Fix& fix : flight.fixes) fix.covariance = Eigen::Matrix3d::Identity();
  FusionOptions fusion;
  fusion.window_keyframes = 0;
  fusion.max_iterations = 50;
  fusion.edge.scale_stddev = 10.0;  // no pull towards a scale of 1
  fusion.edge.scale_time = 1e6;     // and no forgetting
  StateVector stddev = wide();
  stddev(kScale) = 10.0;
  Driven driven(fusion);
  driven.drive(flight, 300, stddev);
  const Keyframe& newest = driven.graph.newest();
  const size_t state = 3 * static_cast<size_t>(newest.id);
  EXPECT_LT((driven.graph.state(newest.id).p() - flight.truth[state]).norm(), 0.02);
  const double odometry = (flight.states[state].p_W_B - flight.states[0].p_W_B).norm();
  const double truth = (flight.truth[state] - flight.truth[0]).norm();
  EXPECT_NEAR(std::exp(driven.graph.state(newest.id).log_scale()), truth / odometry, 2e-3);
}

TEST(PoseGraph, TheSolutionWithoutTheNewestFixesIsTheOneThatNeverHadThem) {
  const SyntheticFlight flight = make_flight(clean(), 4);
  FusionOptions options;
  options.max_iterations = 20;
  options.fix.huber = 1e9;  // weights would differ between the two
  Driven all(options), some(options);
  all.drive(flight, 200);
  some.drive(flight, 200, wide(), 150);
  const std::optional<Estimate> without = all.graph.without_fixes_after(flight.keyframes[150].utime);
  ASSERT_TRUE(without);
  const Estimate never = some.graph.estimate(199);
  EXPECT_LT(without->state.q_G_W().angularDistance(never.state.q_G_W()), 1e-3);
  const StateVector stddev = never.covariance.diagonal().cwiseSqrt();
  for (int k = 0; k < kStates; ++k) {
    EXPECT_LT(std::abs(without->state.x(k) - never.state.x(k)), 0.1 * stddev(k)) << k;
    EXPECT_NEAR(std::sqrt(without->covariance(k, k)) / stddev(k), 1.0, 0.05) << k;
  }
  EXPECT_FALSE(all.graph.without_fixes_after(flight.keyframes[0].utime - 1));
}

TEST(PoseGraph, TheCompassBiasIsFoundOnceFixesGiveTheHeading) {
  const SyntheticFlight flight = make_flight(clean(), 6);
  FusionOptions options;
  Driven driven(options);
  const int count = static_cast<int>(flight.keyframes.size());
  driven.drive(flight, flight.keyframes.size());
  const double bias = 0.12;
  for (int id = count - 150; id < count; ++id) {
    const double heading = heading_of(flight.truth_q[3 * static_cast<size_t>(id)]);
    driven.graph.add_compass(id, heading + bias, 0.05);
  }
  driven.graph.solve();
  const Estimate newest = driven.graph.estimate(count - 1);
  const double stddev = std::sqrt(newest.covariance(kCompassBias, kCompassBias));
  EXPECT_LT(stddev, 0.03) << "a third of what was known before";
  EXPECT_NEAR(newest.state.compass_bias(), bias, 3.0 * stddev);
}

TEST(PoseGraph, RefusesKeyframesThatGoBack) {
  const SyntheticFlight flight = make_flight(clean(), 1);
  PoseGraph graph{FusionOptions{}};
  EXPECT_THROW(graph.append(flight.keyframes[0]), std::invalid_argument);
  graph.start(flight.keyframes[5], NodeState(), wide());
  EXPECT_THROW(graph.append(flight.keyframes[5]), std::invalid_argument);
  EXPECT_THROW(graph.append(flight.keyframes[4]), std::invalid_argument);
  EXPECT_THROW(graph.add_position(4, Eigen::Vector3d::Zero(), Eigen::Matrix3d::Identity()), std::out_of_range);
}

}  // namespace
}  // namespace orthonav::fusion
