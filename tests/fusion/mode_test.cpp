// Every transition of the modes, and the protection levels' arithmetic.
#include "services/fusion/mode.h"

#include <gtest/gtest.h>

#include "services/fusion/protection.h"

namespace orthonav::fusion {
namespace {

Evidence aided(double t, int moves = 1) {
  Evidence evidence;
  evidence.utime = static_cast<int64_t>(1e6 * t);
  evidence.odometry = evidence.located = true;
  evidence.time_since_fix = 0.5;
  evidence.moves = moves;
  return evidence;
}

TEST(Modes, WaitThenReckonThenAreAided) {
  ModeMachine modes{FusionOptions{}};
  Evidence evidence;
  EXPECT_EQ(modes.update(evidence), Mode::kWaitingForVio);
  evidence.odometry = true;
  EXPECT_EQ(modes.update(evidence), Mode::kDeadReckoning);
  EXPECT_EQ(modes.update(aided(1)), Mode::kMapAided) << "a first lock is no re-acquisition";
}

TEST(Modes, CoastWithoutFixesAndAreAidedAgain) {
  ModeMachine modes{FusionOptions{}};
  modes.update(aided(1));
  Evidence evidence = aided(10);
  evidence.time_since_fix = 6.0;
  EXPECT_EQ(modes.update(evidence), Mode::kCoasting);
  EXPECT_EQ(modes.update(aided(11)), Mode::kMapAided);
}

TEST(Modes, AreLostWhenContradictedAndOnlyAFixEndsIt) {
  ModeMachine modes{FusionOptions{}};
  modes.update(aided(1));
  Evidence evidence = aided(10);
  evidence.contradicted = true;
  EXPECT_EQ(modes.update(evidence), Mode::kLost) << "another place is likelier, however new the newest fix is";
  evidence.time_since_fix = 6.0;
  EXPECT_EQ(modes.update(evidence), Mode::kLost);
  evidence.contradicted = false;
  EXPECT_EQ(modes.update(evidence), Mode::kLost);
  EXPECT_EQ(modes.update(aided(12)), Mode::kReacquired);
  EXPECT_EQ(modes.update(aided(16)), Mode::kReacquired);
  EXPECT_EQ(modes.update(aided(18)), Mode::kMapAided);
}

TEST(Modes, AreLostWhenTooUncertain) {
  ModeMachine modes{FusionOptions{}};
  modes.update(aided(1));
  Evidence evidence = aided(100);
  evidence.time_since_fix = 60.0;
  evidence.level = 150.0;
  EXPECT_EQ(modes.update(evidence), Mode::kLost);
}

TEST(Modes, AMoveToAnotherPlaceIsAReacquisition) {
  ModeMachine modes{FusionOptions{}};
  modes.update(aided(1, 1));
  EXPECT_EQ(modes.update(aided(2, 2)), Mode::kReacquired);
}

TEST(Modes, WithoutAPositionAfterOneIsLostNotReckoning) {
  ModeMachine modes{FusionOptions{}};
  modes.update(aided(1));
  Evidence evidence;
  evidence.odometry = true;
  EXPECT_EQ(modes.update(evidence), Mode::kLost);
}

TEST(Modes, TheInertialSensorAloneCoasts) {
  ModeMachine modes{FusionOptions{}};
  modes.update(aided(1));
  Evidence evidence = aided(2);
  evidence.blind = true;
  EXPECT_EQ(modes.update(evidence), Mode::kCoasting);
}

TEST(Protection, TheQuantilesAreThoseOfOneInTenThousand) {
  EXPECT_NEAR(std::exp(-0.5 * kHorizontalQuantile * kHorizontalQuantile), 1e-4, 1e-6);
  EXPECT_NEAR(std::erfc(kVerticalQuantile / std::sqrt(2.0)), 1e-4, 1e-6);
}

TEST(Protection, ReachesToTheFurthestHypothesis) {
  Located given;
  given.covariance = Eigen::Vector3d(1.0, 4.0, 9.0).asDiagonal();
  Located without = given;
  without.p_G_B = Eigen::Vector3d(3.0, 4.0, -2.0);
  Protection level = protect(given, without, std::nullopt);
  EXPECT_NEAR(level.horizontal, 5.0 + kHorizontalQuantile * 2.0, 1e-9);
  EXPECT_NEAR(level.vertical, 2.0 + kVerticalQuantile * 3.0, 1e-9);
  Located rival = given;
  rival.p_G_B = Eigen::Vector3d(60.0, 0.0, 0.0);
  level = protect(given, without, rival);
  EXPECT_NEAR(level.horizontal, 60.0 + kHorizontalQuantile * 2.0, 1e-9);
}

TEST(Protection, TheLargerAxisOfATurnedEllipseCounts) {
  Eigen::Matrix3d covariance = Eigen::Matrix3d::Identity();
  covariance.topLeftCorner<2, 2>() << 2.5, 1.5, 1.5, 2.5;  // axes 4 and 1
  EXPECT_NEAR(horizontal_stddev(covariance), 2.0, 1e-12);
}

TEST(Protection, GrowsWithTheCovarianceAndNeverShrinks) {
  const Eigen::Matrix3d small = Eigen::Matrix3d::Identity();
  const Eigen::Matrix3d large = 4.0 * Eigen::Matrix3d::Identity();
  const Protection level = carried_on({10.0, 10.0}, small, large);
  EXPECT_NEAR(level.horizontal, std::sqrt(100.0 + 3.0 * kHorizontalQuantile * kHorizontalQuantile), 1e-9);
  EXPECT_EQ(carried_on({10.0, 10.0}, large, small).vertical, 10.0);
  EXPECT_TRUE(std::isnan(carried_on(Protection(), small, large).horizontal));
}

}  // namespace
}  // namespace orthonav::fusion
