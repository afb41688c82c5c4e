// What fixes that agree make of a place: closed forms, and what the fusion does by them.
#include "services/fusion/agreement.h"

#include <cmath>

#include <gtest/gtest.h>

#include "services/fusion/fusion.h"

namespace orthonav::fusion {
namespace {

constexpr double kHeight = 100.0;
constexpr int64_t kStart = 1'700'000'000'000'000;
const Geodetic kAnchor{47.5, 8.7, 420.0};

Keyframe at(double seconds, const Eigen::Vector2d& p_W) {
  Keyframe keyframe;
  keyframe.utime = kStart + std::llround(1e6 * seconds);
  keyframe.p_W_B << p_W, kHeight;
  keyframe.height_above_ground = kHeight;
  return keyframe;
}

Fix that_says(double log_odds) {
  Fix fix;
  fix.log_odds = log_odds;
  return fix;
}

TEST(Agreement, IsWorthWhatTheSurestSaysAndHowRarelyAWrongPlaceHoldsForSoLong) {
  const LockOptions options;
  Agreement agreement;
  EXPECT_EQ(agreement.place_log_odds(kStart, options), -std::numeric_limits<double>::infinity());
  agreement.add(at(0, {0, 0}), that_says(7.0), kHeight, options);
  agreement.add(at(0, {options.wrong_distance, 0}), that_says(8.0), kHeight, options);
  agreement.add(at(0, {-2 * options.wrong_distance, 0}), that_says(kUnknown), kHeight, options);
  for (int k = 0; k < 9; ++k) agreement.add(at(0, {0, 0}), that_says(kUnknown), kHeight, options);
  const double held = 3 * std::log(1 + 2);
  EXPECT_NEAR(agreement.place_log_odds(kStart, options), 8.0 + held, 1e-9);
  EXPECT_NEAR(agreement.accuracy_log_odds(kStart, options), log_odds_of(options.fix_probability) + held, 1e-9);
  Agreement two;
  two.add(at(0, {0, 0}), that_says(7.0), kHeight, options);
  two.add(at(0, {1e4, 0}), that_says(7.0), kHeight, options);
  EXPECT_NEAR(two.place_log_odds(kStart, options), 8.0, 1e-9) << "two may agree by chance, however far apart";
  // Back where it was, and up: no more.
  agreement.add(at(0, {0, 0}), that_says(7.0), 10 * kHeight, options);
  EXPECT_NEAR(agreement.place_log_odds(kStart, options), 8.0 + held, 1e-9);
}

TEST(Agreement, NeverSurerThanAnybodyHasCountedNorThanTheOdometryStands) {
  const LockOptions options;
  Agreement agreement;
  agreement.add(at(0, {0, 0}), that_says(300.0), kHeight, options);
  EXPECT_NEAR(agreement.place_log_odds(kStart, options), log_odds_of(0.9999), 1e-9);
  for (int k = 0; k < 30; ++k) agreement.add(at(0, {1e4, 0}), that_says(300.0), kHeight, options);
  const int64_t later = kStart + 36'000'000;
  EXPECT_NEAR(agreement.place_log_odds(later, options), std::log(options.jump_time / 36.0), 1e-6);
}

// A straight flight at 10 m/s, a keyframe each second, whose fixes say where it is in G, m, and how sure they are.
class ByOdds : public ::testing::Test {
 protected:
  Outcome fly(const Eigen::Vector3d& off, double log_odds, double step = 10.0) {
    const Keyframe keyframe = move(step);
    const Outcome outcome = fusion_.add_fix(fix_of(keyframe, off, log_odds));
    look(keyframe, true);
    return outcome;
  }
  Keyframe move(double step) {
    p_.x() += step;
    Keyframe keyframe = at(++id_, p_);
    keyframe.session = 1;
    keyframe.id = id_;
    EXPECT_EQ(fusion_.add_keyframe(keyframe), Outcome::kUsed);
    return keyframe;
  }
  static Fix fix_of(const Keyframe& keyframe, const Eigen::Vector3d& off, double log_odds) {
    Fix fix = that_says(log_odds);
    fix.utime = keyframe.utime;
    fix.session = 1;
    fix.keyframe_id = keyframe.id;
    fix.anchor = kAnchor;
    fix.position = EnuFrame(kAnchor).to_geodetic(keyframe.p_W_B + off);
    fix.covariance = Eigen::Matrix3d::Identity();
    fix.heading = M_PI_2;
    fix.heading_stddev = 0.02;
    fix.heading_fitted = true;
    return fix;
  }
  void look(const Keyframe& keyframe, bool has_tracks) {
    OdometryState state;
    state.has_tracks = has_tracks;
    state.utime = keyframe.utime + 100'000;
    state.session = 1;
    state.has_pose = true;
    state.p_W_B = keyframe.p_W_B;
    solution_ = fusion_.propagate(state).solution;
  }
  Fusion fusion_{FusionOptions{}};
  Eigen::Vector2d p_{0, 0};
  int id_ = 0;
  Solution solution_;
  const Eigen::Vector3d elsewhere_{200, 100, 0};
};

TEST_F(ByOdds, OneFixThatIsSureLocksAndOneThatIsNotWaits) {
  EXPECT_EQ(fly({0, 0, 0}, 5.0), Outcome::kWaiting);
  EXPECT_EQ(fly(elsewhere_, 9.0), Outcome::kWaiting) << "against the other place it is not sure any more";
  Fusion fresh{FusionOptions{}};
  std::swap(fusion_, fresh);
  EXPECT_EQ(fly({0, 0, 0}, 9.0), Outcome::kLocked);
  EXPECT_EQ(solution_.mode, Mode::kMapAided);
  EXPECT_TRUE(std::isnan(solution_.horizontal_protection_level)) << "one fix bounds nothing";
}

TEST_F(ByOdds, AnotherPlaceIsReckonedWithAtOnceLikelierSoonAndMovedToWhenSure) {
  for (int k = 0; k < 60; ++k) fly({0, 0, 0}, 9.0);
  ASSERT_LT(solution_.horizontal_protection_level, 20.0);
  EXPECT_EQ(fly(elsewhere_, 9.0), Outcome::kOutlier);
  EXPECT_GT(solution_.horizontal_protection_level, elsewhere_.head<2>().norm());
  int lost = 1;
  while (solution_.mode != Mode::kLost && lost < 20) {
    EXPECT_EQ(fly(elsewhere_, 9.0), Outcome::kOutlier);
    ++lost;
  }
  EXPECT_LE(lost, 3) << "s";
  int moved = lost;
  for (Outcome outcome = Outcome::kOutlier; outcome != Outcome::kRelocked && moved < 20; ++moved) {
    outcome = fly(elsewhere_, 9.0);
  }
  EXPECT_LE(moved, 10) << "s";
  EXPECT_EQ(solution_.mode, Mode::kReacquired);
}

TEST_F(ByOdds, AFixThatIsSureAndWrongMovesNothing) {
  for (int k = 0; k < 60; ++k) fly({0, 0, 0}, 9.0);
  for (int k = 0; k < 40; ++k) {
    EXPECT_EQ(fly(elsewhere_ + Eigen::Vector3d(37.0 * k, 0, 0), 300.0), Outcome::kOutlier);
    EXPECT_GT(solution_.horizontal_protection_level, elsewhere_.head<2>().norm()) << "it may be so";
    for (int right = 0; right < 3; ++right) {
      EXPECT_EQ(fly({0, 0, 0}, 300.0), Outcome::kUsed);
      EXPECT_LT(solution_.horizontal_protection_level, 20.0) << "it was not";
      EXPECT_NE(solution_.mode, Mode::kLost);
    }
  }
  EXPECT_EQ(solution_.reset_counter, 1);
}

TEST_F(ByOdds, WhereFixesOfOnePlaceDisagreeItsOddsDoNotCount) {
  for (int k = 0; k < 60; ++k) fly({0, 0, 0}, 9.0);
  for (int k = 0; k < 3; ++k) EXPECT_EQ(fly({9, 0, 0}, 9.0, 1.0), Outcome::kOutlier);
  EXPECT_NE(solution_.mode, Mode::kLost) << "3 m of way tell little";
  int moved = 0;
  while (fly({9, 0, 0}, 9.0) != Outcome::kRelocked && moved < 30) ++moved;
  EXPECT_LE(moved, 20) << "keyframes: it is left all the same when enough ground says so";
}

TEST_F(ByOdds, AFixOfBeforeSightWasLostConfirmsNothing) {
  for (int k = 0; k < 60; ++k) fly({0, 0, 0}, 9.0);
  const Keyframe before = move(10.0);
  look(before, false);
  ASSERT_EQ(solution_.mode, Mode::kCoasting);
  EXPECT_EQ(fusion_.add_fix(fix_of(before, {0, 0, 0}, 300.0)), Outcome::kUsed);
  EXPECT_TRUE(fusion_.unconfirmed());
  EXPECT_EQ(fly(elsewhere_, 300.0), Outcome::kRelocked) << "one sure fix is enough where nothing later has agreed";
}

TEST_F(ByOdds, OddsThatAreNoNumberAreRefused) {
  EXPECT_EQ(fly({0, 0, 0}, std::numeric_limits<double>::infinity()), Outcome::kBadNumber);
  EXPECT_EQ(fly({0, 0, 0}, -1e300), Outcome::kBadNumber);
}

}  // namespace
}  // namespace orthonav::fusion
