// The lean, the error of the odometry's vertical, against the mechanics that it comes from: no sign here is taken from
// the code under test.
#include <cmath>

#include <gtest/gtest.h>

#include "common/math/so3.h"
#include "services/fusion/consensus.h"
#include "services/fusion/error_budget.h"
#include "services/fusion/pose_graph.h"
#include "tests/fusion/faults.h"
#include "tests/fusion/fly.h"

namespace orthonav::fusion {
namespace {

const Eigen::Vector3d kUp = Eigen::Vector3d::UnitZ();

TEST(Lean, ChangesByWhatTheOdometryLevelsItsAttitudeBy) {
  // The truth in the odometry's world before and after a turn of the published attitude alone.
  const Eigen::Quaterniond q_G_B = Eigen::AngleAxisd(2.2, kUp) * Eigen::AngleAxisd(0.15, Eigen::Vector3d::UnitY()) *
                                   Eigen::AngleAxisd(-0.1, Eigen::Vector3d::UnitX());
  const Eigen::Vector2d turned(0.013, -0.011);
  Keyframe before, after;
  before.q_W_B = Eigen::AngleAxisd(-1.1, kUp) * so3_exp(Eigen::Vector3d(0.004, 0.015, 0)) * q_G_B;
  after.q_W_B = so3_exp(Eigen::Vector3d(turned.x(), turned.y(), 0)) * before.q_W_B;
  after.levelled = turned;
  after.id = 1;
  after.utime = 500'000;
  for (Keyframe* keyframe : {&before, &after}) keyframe->height_above_ground = 100.0;
  // R_G_W without its yaw: what is left is the lean.
  const auto lean_of = [&](const Keyframe& keyframe) {
    const Eigen::Quaterniond q_G_W = q_G_B * keyframe.q_W_B.conjugate();
    return so3_log(Eigen::AngleAxisd(-yaw_of(q_G_W), kUp) * q_G_W);
  };
  const Eigen::Vector3d change = lean_of(after) - lean_of(before);
  ASSERT_GT(change.head<2>().cwiseAbs().minCoeff(), 0.009);
  const Transition transition = transition_between(FusionOptions{}, before, after, Eigen::Quaterniond::Identity());
  EXPECT_LT((transition.lean_change - change.head<2>()).norm(), 2e-4) << transition.lean_change.transpose();
}

// The first keyframe of a graph, whose odometry knows its vertical so well.
Keyframe started(PoseGraph& graph, double lean_stddev) {
  Keyframe keyframe;
  keyframe.height_above_ground = 100.0;
  keyframe.lean_stddev = lean_stddev;
  StateVector stddev = StateVector::Constant(1.0);
  stddev.segment<2>(kLean).setConstant(lean_stddev);
  graph.start(keyframe, {}, stddev);
  return keyframe;
}

// The odometry takes its vertical for right at each keyframe: what it knows of the newest, and no sum of what it knew.
TEST(Lean, IsByTheOdometrysNewestWordWhereNothingElseIsKnown) {
  const FusionOptions options;
  PoseGraph graph(options);
  Keyframe keyframe = started(graph, 0.03);
  // It levels its attitude, doubts itself again, and goes on.
  for (const double known : {0.03, 0.02, 0.01, 0.025, 0.012}) {
    ++keyframe.id;
    keyframe.utime += 1'000'000;
    keyframe.levelled += Eigen::Vector2d(0.003, -0.002);
    keyframe.lean_stddev = known;
    graph.append(keyframe);
    graph.solve();
    const Estimate estimate = graph.estimate(keyframe.id);
    EXPECT_LT(estimate.state.lean().norm(), 1e-9) << known;
    EXPECT_NEAR(std::sqrt(estimate.covariance(kLean, kLean)), known, 1e-6);
    EXPECT_NEAR(std::sqrt(estimate.covariance(kLean + 1, kLean + 1)), known, 1e-6);
  }
  // And no better than the configuration has it, or where it does not say.
  for (const double word : {1e-4, kUnknown, 1e200, 1e-4}) {
    ++keyframe.id;
    keyframe.utime += 1'000'000;
    keyframe.lean_stddev = word;
    graph.append(keyframe);
    const double known = word < 1e100 || std::isnan(word) ? options.edge.lean_stddev : 1.0;
    EXPECT_NEAR(std::sqrt(graph.estimate(keyframe.id).covariance(kLean, kLean)), known, 1e-6);
  }
}

// What fixes have told of the lean is carried along as the odometry changes its mind, and weighed against its word.
TEST(Lean, ThatFixesHaveToldIsCarriedAlong) {
  const FusionOptions options;
  PoseGraph graph(options);
  Keyframe keyframe = started(graph, 0.02);
  graph.add_tilt(0, {0.012, 0.0}, 0.01 * 0.01 * Eigen::Matrix2d::Identity());
  keyframe.id = 1;
  keyframe.utime = 1000;
  keyframe.levelled = Eigen::Vector2d(-0.01, 0.0);
  keyframe.lean_stddev = 0.015;
  graph.append(keyframe);
  graph.solve();
  // Of the fix 0.022 to 0.01, of the odometry 0 to 0.015.
  const double of_fix = 1 / (0.01 * 0.01), of_odometry = 1 / (0.015 * 0.015);
  const Estimate estimate = graph.estimate(1);
  EXPECT_NEAR(estimate.state.lean().x(), 0.022 * of_fix / (of_fix + of_odometry), 1e-5);
  EXPECT_NEAR(estimate.covariance(kLean, kLean), 1 / (of_fix + of_odometry), 1e-7);
}

// Fixes of one place, 285 m above it, before and after the odometry has levelled its attitude by half a degree.
TEST(Lean, ThatTheOdometryHasLevelledMeanwhileIsNoDisagreement) {
  Sighting a, b;
  a.lever = b.lever = lever_of_height(285.0);
  a.covariance = b.covariance = 0.1 * Eigen::Matrix3d::Identity();
  a.yaw_G_W = b.yaw_G_W = 0.7;
  b.keyframe.p_W_B = Eigen::Vector3d(10.0, 0.0, 0.0);
  b.keyframe.levelled = Eigen::Vector2d(0.006, -0.006);
  const Eigen::Rotation2Dd R(0.7);
  b.p_G_B.head<2>() = R * Eigen::Vector2d(10.0, 0.0);
  b.p_G_B += b.lever * (R * -b.keyframe.levelled);  // less lean, and found less far off
  EXPECT_LT(disagreement(a, b, FusionOptions{}), 1e-6);
  b.keyframe.levelled.setZero();
  EXPECT_GT(disagreement(a, b, FusionOptions{}), 4.0);
}

TEST(Lean, MovesAFixOverThePointsThatItSees) {
  // Leaning to the east and thought upright: the point under the body is seen to the west, or the body east of it.
  const double height = 285.0;
  const double angle = 0.01;
  const Lever lever = lever_of_height(height);
  const Eigen::Vector3d point(40.0, -20.0, 430.0), body = point + height * kUp;
  for (const Eigen::Vector3d& axis :
       {Eigen::Vector3d(1, 0, 0), Eigen::Vector3d(0, 1, 0), Eigen::Vector3d(0.6, -0.8, 0)}) {
    const Eigen::Quaterniond q_G_B(Eigen::AngleAxisd(angle, axis));
    const Eigen::Vector3d ray_B = q_G_B.conjugate() * (point - body);  // as the camera has it
    const Eigen::Vector3d fix = point - ray_B;                         // by a body that takes itself for upright
    const Eigen::Vector3d moved = lever * (angle * axis).head<2>();
    EXPECT_LT((fix - body - moved).norm(), 0.02) << axis.transpose();
    EXPECT_NEAR(moved.norm(), height * angle, 1e-9);
  }
}

// High up, where the lean is most of what fixes err by.
SyntheticOptions high() {
  SyntheticOptions options;
  options.duration = 120.0;
  options.keyframe_interval = 0.5;
  options.height = 285.0;
  options.speed = 6.0;
  options.single_wrong_rate = 0.0;
  options.fix_stddev = options.fix_vertical_stddev = 0.3;
  options.fix_shared_stddev = options.fix_shared_vertical_stddev = 0.3;
  options.position_noise = 0.005;
  options.lean = Eigen::Vector2d(0.0087, -0.0087);  // 0.5 degrees each
  return options;
}

double horizontal_error(const SyntheticFlight& flight, const Flown& flown, size_t state) {
  const Solution& solution = flown.solutions[state];
  if (!solution.located()) return std::nan("");
  return (EnuFrame(flight.anchor).to_enu(solution.position) - flight.truth[state]).head<2>().norm();
}

TEST(Lean, IsNoFallWhileTheInertialSensorAloneCarriesThePosition) {
  SyntheticOptions options = high();
  options.imu = true;
  for (uint64_t seed = 1; seed <= 3; ++seed) {
    SyntheticFlight flight = make_flight(options, seed);
    faults::restart_odometry(flight, 80.0, 9.5);
    const Flown flown = fly(flight, FusionOptions{});
    // Gravity times the lean is 6.8 m by then; what the odometry does not know of the bias, 0.02 m/s^2 an axis, 1.3 m.
    EXPECT_LT(horizontal_error(flight, flown, 892), 4.0) << "seed " << seed;
    EXPECT_TRUE(flown.solutions[892].inertial || flown.solutions[892].mode == Mode::kCoasting) << "seed " << seed;
    EXPECT_LT((flown.solutions[892].q_G_B.angularDistance(flight.truth_q[892])), 0.012) << "seed " << seed;
  }
}

TEST(Lean, IsFollowedWhenTheOdometryLearnsItsBiasAllAtOnce) {
  SyntheticOptions options = high();
  options.imu = true;
  options.lean_learnt_at = 80.0;
  options.perspective_stddev = 0.003;
  for (uint64_t seed = 1; seed <= 3; ++seed) {
    const SyntheticFlight flight = make_flight(options, seed);
    const Flown flown = fly(flight, FusionOptions{});
    for (size_t k = 795; k < 830; ++k) {
      // Tilt of the attitude given out: also between the change and the next keyframe.
      const Eigen::Vector3d up = flown.solutions[k].q_G_B * (flight.truth_q[k].conjugate() * kUp);
      EXPECT_LT(up.head<2>().norm(), 0.004) << "seed " << seed << ", state " << k;
      EXPECT_LT(horizontal_error(flight, flown, k), 2.0) << "seed " << seed << ", state " << k;
    }
    EXPECT_EQ(flown.misleading_horizontal + flown.misleading_vertical, 0) << "seed " << seed;
  }
}

TEST(Lean, IsTakenFromWhereFixesThatAreNotBelievedAgreeToBe) {
  // As far as these fixes are off, and no further: they lean as all others do.
  const Eigen::Vector3d aside(80.0, -60.0, 0.0);
  const auto levels = [&](const Eigen::Vector2d& lean) {
    SyntheticOptions options = high();
    options.lean = lean;
    options.perspective_stddev = 0.001;
    SyntheticFlight flight = make_flight(options, 2);
    faults::shift_fixes(flight, 90.0, 105.0, aside);
    const Flown flown = fly(flight, FusionOptions{});
    EXPECT_EQ(flown.wrong_used, 0);
    std::vector<double> result;
    for (size_t k = 1000; k < 1050; ++k) result.push_back(flown.solutions[k].horizontal_protection_level);
    return result;
  };
  const std::vector<double> upright = levels(Eigen::Vector2d::Zero());
  const std::vector<double> leaning = levels(Eigen::Vector2d(0.02, -0.02));  // 8 m on the ground
  for (size_t k = 0; k < upright.size(); ++k) {
    ASSERT_GT(upright[k], 100.0);
    EXPECT_NEAR(leaning[k], upright[k], 2.0) << k;
  }
}

TEST(Lean, IsNotLearntFromATiltThatNoBodyHas) {
  // As registration once gave it of 20 matches: 475 and 1009 degrees, known to a millionth, beside a position that was
  // right. Of the first fix of all, and now and then.
  SyntheticOptions options = high();
  options.perspective_stddev = 0.0087;
  SyntheticFlight flight = make_flight(options, 1);
  for (size_t k = 0; k < flight.fixes.size(); k += 20) {
    flight.fixes[k].upright->tilt = Eigen::Vector2d(-8.29, 17.6);
    flight.fixes[k].upright->tilt_covariance = 1e-12 * Eigen::Matrix2d::Identity();
  }
  const Flown flown = fly(flight, FusionOptions{});
  EXPECT_EQ(flown.solutions.back().reset_counter, 1);
  EXPECT_LT(flown.largest, 5.0);
  EXPECT_EQ(flown.misleading_horizontal + flown.misleading_vertical, 0);
}

// Standard deviation of the lean, rad, at the end of a flight whose positions say nothing of it.
double known_lean(const SyntheticFlight& flight, int every) {
  Fusion fusion{FusionOptions{}};
  for (const SyntheticFlight::Step& step : flight.steps) {
    if (step.kind == SyntheticFlight::Step::Kind::kState) fusion.propagate(flight.states[step.index]);
    if (step.kind == SyntheticFlight::Step::Kind::kKeyframe) fusion.add_keyframe(flight.keyframes[step.index]);
    if (step.kind != SyntheticFlight::Step::Kind::kFix || flight.fixes[step.index].keyframe_id % every != 0) continue;
    fusion.add_fix(flight.fixes[step.index]);
  }
  const auto memory = fusion.memory();
  return memory ? std::sqrt(memory->estimate.covariance(kLean, kLean)) : std::nan("");
}

TEST(Lean, IsKnownFromWayAndNotFromLookingOften) {
  SyntheticOptions options = high();
  options.fix_rate = 1.0;
  options.fix_stddev = options.fix_vertical_stddev = 100.0;
  const double stddev = FusionOptions{}.edge.lean_stddev;
  options.perspective_stddev = stddev;
  const SyntheticFlight flight = make_flight(options, 1);
  const double often = known_lean(flight, 1), seldom = known_lean(flight, 6);
  EXPECT_NEAR(often / seldom, 1.0, 0.1);
  // Of 700 m of way, twice what is forgotten of it is worth one fix, and so are the first one and the prior; the
  // robust loss and the lean's own walk take something of it.
  const double worth = 2.0 + 700.0 / (2.0 * 0.25 * 285.0);
  EXPECT_GT(often, stddev / std::sqrt(worth));
  EXPECT_LT(often, 1.3 * stddev / std::sqrt(worth));
}

}  // namespace
}  // namespace orthonav::fusion
