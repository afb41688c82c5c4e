// What the fusion promises to the one who flies by it.
#include <cstring>

#include <gtest/gtest.h>

#include "tests/fusion/fly.h"

namespace orthonav::fusion {
namespace {

SyntheticOptions quick() {
  SyntheticOptions options;
  options.duration = 90.0;
  return options;
}

FusionOptions defaults() {
  return FusionOptions{};
}

int count(const Flown& flown, Outcome outcome) {
  return static_cast<int>(std::count(flown.outcomes.begin(), flown.outcomes.end(), outcome));
}

TEST(Fusion, GivesNoGeodeticPositionBeforeFixesAgree) {
  const SyntheticFlight flight = make_flight(quick(), 1);
  const Flown flown = fly(flight, defaults());
  bool located = false;
  for (const Solution& solution : flown.solutions) {
    const bool has_position = std::isfinite(solution.position.latitude_deg);
    EXPECT_TRUE(!located || has_position);
    if (!has_position) {
      EXPECT_EQ(solution.mode, Mode::kDeadReckoning);
      EXPECT_TRUE(solution.covariance.hasNaN());
      EXPECT_TRUE(std::isnan(solution.time_since_fix));
      EXPECT_EQ(solution.reset_counter, 0);
    } else if (!located) {
      EXPECT_EQ(solution.reset_counter, 1);
      EXPECT_EQ(solution.mode, Mode::kMapAided);
      EXPECT_GE(solution.num_fixes, 2) << "none says how sure it is";
    }
    located = has_position;
  }
  EXPECT_TRUE(located);
}

TEST(Fusion, IsBetterThanItsFixesAndThanItsOdometry) {
  for (uint64_t seed = 1; seed <= 3; ++seed) {
    const SyntheticOptions options;  // a whole flight
    const Flown flown = fly(make_flight(options, seed), defaults());
    // A fix: 2.5, 2.5 and 3 m white and 1 m per axis shared.
    EXPECT_LT(flown.rmse, 0.5 * std::sqrt(2 * 6.25 + 9.0 + 3.0)) << "seed " << seed;
    EXPECT_EQ(flown.wrong_used, 0) << "seed " << seed;
    EXPECT_LT(flown.heading_rmse, 0.03) << "seed " << seed;  // the compass's bias is 0.05
  }
}

TEST(Fusion, ARunOfWrongFixesDoesNotMoveTheSolution) {
  SyntheticOptions options;
  options.duration = 200.0;
  options.single_wrong_rate = 0.0;
  for (uint64_t seed = 1; seed <= 3; ++seed) {
    SyntheticFlight flight = make_flight(options, seed);
    const EnuFrame frame(flight.anchor);
    const Flown clean = fly(flight, defaults());
    // Twenty in a row, 60 m aside, moving with the aircraft.
    for (size_t k = 200; k < 220; ++k) {
      Fix& fix = flight.fixes[k];
      fix.position = frame.to_geodetic(frame.to_enu(fix.position) + Eigen::Vector3d(50.0, 33.0, 2.0));
      flight.wrong[k] = true;
    }
    const Flown flown = fly(flight, defaults());
    EXPECT_EQ(flown.wrong_used, 0);
    EXPECT_EQ(flown.solutions.back().reset_counter, 1);
    EXPECT_LT(flown.largest, clean.largest + 2.0) << "seed " << seed;
  }
}

TEST(Fusion, LeavesAWrongLockWhenMoreFixesAgreeElsewhere) {
  SyntheticOptions options = quick();
  options.single_wrong_rate = 0.0;
  options.wrong_at_start = 20;
  for (uint64_t seed = 1; seed <= 3; ++seed) {
    const SyntheticFlight flight = make_flight(options, seed);
    const Flown flown = fly(flight, defaults());
    EXPECT_EQ(count(flown, Outcome::kLocked), 1);
    EXPECT_EQ(count(flown, Outcome::kRelocked), 1) << "seed " << seed;
    EXPECT_EQ(flown.solutions.back().reset_counter, 2);
    EXPECT_EQ(flown.misleading_horizontal + flown.misleading_vertical, 0) << "seed " << seed;
    const EnuFrame frame(flight.anchor);
    EXPECT_LT((frame.to_enu(flown.solutions.back().position) - flight.truth.back()).norm(), 6.0);
  }
}

TEST(Fusion, CovarianceGrowsWithoutFixesAndTheModeSaysSo) {
  SyntheticFlight flight = make_flight(quick(), 2);
  const int64_t silence_from = flight.states[450].utime;
  std::erase_if(flight.steps, [&](const SyntheticFlight::Step& step) {
    return step.kind == SyntheticFlight::Step::Kind::kFix && flight.fixes[step.index].utime > silence_from;
  });
  const Flown flown = fly(flight, defaults());
  EXPECT_EQ(flown.solutions[440].mode, Mode::kMapAided);
  const Solution& end = flown.solutions.back();
  EXPECT_EQ(end.mode, Mode::kCoasting);
  EXPECT_GT(end.time_since_fix, 40.0);
  EXPECT_GT(end.covariance(0, 0), 2.0 * flown.solutions[440].covariance(0, 0));
}

TEST(Fusion, ANewSessionStartsWithoutAPositionAndFindsItAgain) {
  SyntheticFlight flight = make_flight(quick(), 4);
  SyntheticFlight second = make_flight(quick(), 9);
  Fusion fusion(defaults());
  auto play = [&](SyntheticFlight& played, int session) {
    std::vector<Solution> solutions;
    for (const SyntheticFlight::Step& step : played.steps) {
      switch (step.kind) {
        case SyntheticFlight::Step::Kind::kState:
          played.states[step.index].session = session;
          solutions.push_back(fusion.propagate(played.states[step.index]).solution);
          break;
        case SyntheticFlight::Step::Kind::kKeyframe:
          played.keyframes[step.index].session = session;
          EXPECT_EQ(fusion.add_keyframe(played.keyframes[step.index]), Outcome::kUsed);
          break;
        case SyntheticFlight::Step::Kind::kFix:
          played.fixes[step.index].session = session;
          fusion.add_fix(played.fixes[step.index]);
          break;
        case SyntheticFlight::Step::Kind::kCompass:
          fusion.add_compass(played.compass[step.index]);
          break;
        case SyntheticFlight::Step::Kind::kImu:
          break;
      }
    }
    return solutions;
  };
  const std::vector<Solution> before = play(flight, 1);
  EXPECT_EQ(before.back().mode, Mode::kMapAided);
  const std::vector<Solution> after = play(second, 2);
  EXPECT_EQ(after.front().mode, Mode::kLost);
  EXPECT_TRUE(std::isnan(after.front().position.latitude_deg));
  EXPECT_EQ(after.front().reset_counter, before.back().reset_counter + 1);
  EXPECT_EQ(after.back().mode, Mode::kMapAided);
  const auto reacquired = [](const Solution& solution) { return solution.mode == Mode::kReacquired; };
  EXPECT_TRUE(std::any_of(after.begin(), after.end(), reacquired));
  EXPECT_EQ(after.back().reset_counter, before.back().reset_counter + 1) << "lost and found again is one jump";
  const EnuFrame frame(second.anchor);
  EXPECT_LT((frame.to_enu(after.back().position) - second.truth.back()).norm(), 6.0);

  Fix old = flight.fixes.back();
  EXPECT_EQ(fusion.add_fix(old), Outcome::kOldSession);
  EXPECT_EQ(fusion.add_keyframe(flight.keyframes.back()), Outcome::kOldSession);
  EXPECT_EQ(fusion.propagate(flight.states.back()).outcome, Outcome::kOldSession);
}

TEST(Fusion, ALateFixActsOnItsOwnKeyframe) {
  SyntheticOptions options = quick();
  const Flown prompt = fly(make_flight(options, 6), defaults());
  options.fix_delay = 15;  // 4.5 s
  const Flown late = fly(make_flight(options, 6), defaults());
  EXPECT_LT(late.rmse, prompt.rmse + 1.0);
}

TEST(Fusion, FixesOfAMapWithAnotherAnchorAreConverted) {
  SyntheticFlight flight = make_flight(quick(), 7);
  const Flown one = fly(flight, defaults());
  const Geodetic elsewhere{47.53, 8.65, 300.0};
  for (size_t k = flight.fixes.size() / 2; k < flight.fixes.size(); ++k) flight.fixes[k].anchor = elsewhere;
  const Flown two = fly(flight, defaults());
  EXPECT_EQ(two.solutions.back().reset_counter, 1);
  EXPECT_EQ(two.solutions.back().anchor.latitude_deg, flight.anchor.latitude_deg);
  EXPECT_NEAR(two.rmse, one.rmse, 1e-9);
}

TEST(Fusion, RepeatsBitForBit) {
  const SyntheticFlight flight = make_flight(quick(), 8);
  const Flown a = fly(flight, defaults());
  const Flown b = fly(flight, defaults());
  ASSERT_EQ(a.solutions.size(), b.solutions.size());
  for (size_t k = 0; k < a.solutions.size(); ++k) {
    EXPECT_EQ(std::memcmp(a.solutions[k].p_G_B.data(), b.solutions[k].p_G_B.data(), 3 * sizeof(double)), 0);
  }
}

// A flight along `way` (m in G, of each keyframe), with a fix of each.
class ByHand : public ::testing::Test {
 protected:
  void fly(const Eigen::Vector3d& way, int keyframes) {
    for (int k = 0; k < keyframes; ++k, ++id_) {
      p_ += way;
      Keyframe keyframe;
      keyframe.id = id_;
      keyframe.session = 1;
      keyframe.utime = 1'700'000'000'000'000 + 500'000 * id_;
      keyframe.p_W_B = p_;
      keyframe.height_above_ground = p_.z();
      ASSERT_EQ(fusion_.add_keyframe(keyframe), Outcome::kUsed);
      Fix fix;
      fix.utime = keyframe.utime;
      fix.session = 1;
      fix.keyframe_id = id_;
      fix.anchor = {47.5, 8.7, 420.0};
      fix.position = EnuFrame(fix.anchor).to_geodetic(p_ + Eigen::Vector3d(300.0, -200.0, 0.0));
      fix.covariance = Eigen::Matrix3d::Identity();
      fix.heading = M_PI_2;
      fix.heading_stddev = 0.05;
      fusion_.add_fix(fix);
      OdometryState state;
      state.utime = keyframe.utime + 100'000;
      state.session = 1;
      state.has_pose = true;
      state.p_W_B = p_;
      solution_ = fusion_.propagate(state).solution;
    }
  }
  Fusion fusion_{defaults()};
  Eigen::Vector3d p_{0.0, 0.0, 20.0};
  int id_ = 0;
  Solution solution_;
};

TEST_F(ByHand, AClimbOverOnePlaceIsNoEvidenceOfIt) {
  fly({0.0, 0.0, 1.5}, 60);
  EXPECT_FALSE(fusion_.locked()) << "any place agrees about a climb";
  fly({1.5, 0.0, 0.0}, 10);
  EXPECT_TRUE(fusion_.locked());
}

TEST_F(ByHand, AClimbConfirmsNoLock) {
  fly({1.5, 0.0, 0.0}, 12);
  ASSERT_TRUE(fusion_.locked());
  fly({0.0, 0.0, 1.5}, 70);
  EXPECT_TRUE(std::isnan(solution_.horizontal_protection_level));
  EXPECT_GT(std::sqrt(solution_.covariance(0, 0)), 0.45) << "all see the same map: 0.5 m are shared";
  fly({0.0, 1.5, 0.0}, 40);
  EXPECT_TRUE(std::isfinite(solution_.horizontal_protection_level));
}

class BadInput : public ::testing::Test {
 protected:
  void SetUp() override {
    flight_ = make_flight(quick(), 1);
    for (size_t k = 0; k < 100; ++k) ASSERT_EQ(fusion_.add_keyframe(flight_.keyframes[k]), Outcome::kUsed);
  }
  Fix fix_of(int keyframe) const {
    Fix fix = flight_.fixes[0];
    fix.keyframe_id = keyframe;
    fix.utime = flight_.keyframes[static_cast<size_t>(keyframe)].utime;
    return fix;
  }
  SyntheticFlight flight_;
  Fusion fusion_{defaults()};
};

TEST_F(BadInput, KeyframesThatAreNoneAreRefused) {
  Keyframe keyframe = flight_.keyframes[100];
  keyframe.p_W_B.x() = kUnknown;
  EXPECT_EQ(fusion_.add_keyframe(keyframe), Outcome::kBadNumber);
  keyframe = flight_.keyframes[100];
  keyframe.q_W_B.coeffs().setZero();
  EXPECT_EQ(fusion_.add_keyframe(keyframe), Outcome::kBadNumber);
  keyframe = flight_.keyframes[100];
  keyframe.p_W_B.setConstant(1e9);
  EXPECT_EQ(fusion_.add_keyframe(keyframe), Outcome::kBadNumber);
  for (const double levelled : {kUnknown, 1e9}) {
    keyframe = flight_.keyframes[100];
    keyframe.levelled.setConstant(levelled);
    EXPECT_EQ(fusion_.add_keyframe(keyframe), Outcome::kBadNumber);
    OdometryState state = flight_.states[500];
    state.levelled.setConstant(levelled);
    EXPECT_EQ(fusion_.propagate(state).outcome, Outcome::kBadNumber);
  }
  keyframe = flight_.keyframes[100];
  keyframe.id = 2'000'000'000;
  EXPECT_EQ(fusion_.add_keyframe(keyframe), Outcome::kBadNumber);
  keyframe = flight_.keyframes[100];
  keyframe.session = 2'000'000'000;
  EXPECT_EQ(fusion_.add_keyframe(keyframe), Outcome::kBadNumber);
  EXPECT_EQ(fusion_.add_keyframe(flight_.keyframes[99]), Outcome::kDuplicate);
  EXPECT_EQ(fusion_.add_keyframe(flight_.keyframes[40]), Outcome::kDuplicate);
  EXPECT_EQ(fusion_.add_keyframe(flight_.keyframes[100]), Outcome::kUsed);
}

TEST_F(BadInput, ACovarianceThatIsNoneIsIgnored) {
  Keyframe keyframe = flight_.keyframes[100];
  keyframe.relative_covariance = -Matrix6d::Identity();
  EXPECT_EQ(fusion_.add_keyframe(keyframe), Outcome::kUsed);
  Fix fix = fix_of(50);
  fix.covariance = -Eigen::Matrix3d::Identity();
  EXPECT_EQ(fusion_.add_fix(fix), Outcome::kBadNumber);
  fix.covariance = 1e12 * Eigen::Matrix3d::Identity();
  EXPECT_EQ(fusion_.add_fix(fix), Outcome::kBadNumber);
}

TEST_F(BadInput, FixesWithoutTheirKeyframeAreRefused) {
  Fix fix = fix_of(50);
  fix.keyframe_id = 5000;
  EXPECT_EQ(fusion_.add_fix(fix), Outcome::kUnknownKeyframe);
  fix = fix_of(50);
  fix.session = 7;
  EXPECT_EQ(fusion_.add_fix(fix), Outcome::kUnknownKeyframe);
  fix = fix_of(50);
  fix.utime += 1;
  EXPECT_EQ(fusion_.add_fix(fix), Outcome::kBadNumber);
  EXPECT_EQ(fusion_.add_fix(fix_of(50)), Outcome::kWaiting);
  EXPECT_EQ(fusion_.add_fix(fix_of(50)), Outcome::kDuplicate);
}

TEST_F(BadInput, FixesThatAreNoPlaceAreRefused) {
  Fix fix = fix_of(50);
  fix.position.latitude_deg = kUnknown;
  EXPECT_EQ(fusion_.add_fix(fix), Outcome::kBadNumber);
  fix = fix_of(50);
  fix.position.height = 1e7;
  EXPECT_EQ(fusion_.add_fix(fix), Outcome::kBadNumber);
  fix = fix_of(50);
  fix.heading = kUnknown;
  EXPECT_EQ(fusion_.add_fix(fix), Outcome::kBadNumber);
  fix = fix_of(50);
  fix.anchor.longitude_deg = kUnknown;
  EXPECT_EQ(fusion_.add_fix(fix), Outcome::kBadNumber);
}

TEST_F(BadInput, AFixOlderThanTheWindowComesTooLate) {
  for (size_t k = 100; k < 290; ++k) fusion_.add_keyframe(flight_.keyframes[k]);
  EXPECT_EQ(fusion_.add_fix(fix_of(5)), Outcome::kTooLate);
}

TEST_F(BadInput, AStateThatIsNoneGivesNoPose) {
  OdometryState state = flight_.states[300];
  state.p_W_B.y() = kUnknown;
  const Fusion::Propagated bad = fusion_.propagate(state);
  EXPECT_EQ(bad.outcome, Outcome::kBadNumber);
  EXPECT_EQ(bad.solution.mode, Mode::kWaitingForVio);
  EXPECT_TRUE(bad.solution.p_G_B.hasNaN());
  EXPECT_EQ(fusion_.propagate(flight_.states[300]).outcome, Outcome::kUsed);
  OdometryState far = flight_.states[301];
  far.p_W_B.x() += 1000.0;
  EXPECT_EQ(fusion_.propagate(far).outcome, Outcome::kJump);
}

TEST_F(BadInput, LostKeyframesAreBridgedByTheOdometry) {
  SyntheticFlight flight = make_flight(quick(), 3);
  std::erase_if(flight.steps, [](const SyntheticFlight::Step& step) {
    return step.kind == SyntheticFlight::Step::Kind::kKeyframe && step.index % 5 == 2;
  });
  const Flown flown = fly(flight, defaults());
  EXPECT_GT(count(flown, Outcome::kUnknownKeyframe), 0);
  EXPECT_LT(flown.rmse, 4.0);
}

TEST_F(BadInput, AnOdometryThatJumpsStartsANewSegment) {
  const SyntheticFlight flight = make_flight(quick(), 3);
  Fusion fusion(defaults());
  for (const SyntheticFlight::Step& step : flight.steps) {
    if (step.kind == SyntheticFlight::Step::Kind::kKeyframe && step.index == 200) break;
    if (step.kind == SyntheticFlight::Step::Kind::kKeyframe) fusion.add_keyframe(flight.keyframes[step.index]);
    if (step.kind == SyntheticFlight::Step::Kind::kFix) fusion.add_fix(flight.fixes[step.index]);
  }
  EXPECT_TRUE(fusion.locked());
  Keyframe jumped = flight.keyframes[200];
  jumped.p_W_B.x() += 500.0;
  EXPECT_EQ(fusion.add_keyframe(jumped), Outcome::kJump);
  EXPECT_FALSE(fusion.locked());
}

}  // namespace
}  // namespace orthonav::fusion
