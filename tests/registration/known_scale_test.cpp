#include "services/registration/submap/known_scale.h"

#include <cmath>

#include <gtest/gtest.h>

namespace orthonav::registration {
namespace {

TEST(ScaleBelief, FollowsAMeasurementThatContradictsTheOdometryByFar) {
  const ScaleBelief belief = with_odometry({0.12, 0.01}, 0.003);
  EXPECT_NEAR(belief.log_scale, 0.12, 0.003);
  EXPECT_NEAR(belief.stddev, 0.01, 0.001);
}

TEST(ScaleBelief, IsBetweenTheTwoWhereTheyAgreeAndAsWideAsTheyAreApartWhereItIsOpen) {
  const ScaleBelief close = with_odometry({0.01, 0.01}, 0.01);
  EXPECT_GT(close.log_scale, 0.003);
  EXPECT_LT(close.log_scale, 0.008);
  EXPECT_LT(close.stddev, 0.01);
  const ScaleBelief open = with_odometry({0.05, 0.018}, 0.003);
  EXPECT_GT(open.log_scale, 0.005);
  EXPECT_LT(open.log_scale, 0.045);
  EXPECT_GT(open.stddev, 0.015);
}

TEST(ScaleBelief, IsTheOdometrysWhereTheMeasurementSaysNothing) {
  for (const double stddev : {3.0, 1e3, 1e9}) {
    const ScaleBelief belief = with_odometry({0.01, stddev}, 0.01);
    EXPECT_NEAR(belief.log_scale, 0, 0.005) << stddev;
    EXPECT_GT(belief.stddev, 0.009) << stddev;
    EXPECT_LT(belief.stddev, 0.2) << stddev;
  }
}

TEST(ScaleBelief, StaysFiniteWhereTheMeasurementIsAbsurd) {
  const ScaleBelief belief = with_odometry({40, 0.001}, 0.003);
  EXPECT_TRUE(std::isfinite(belief.log_scale));
  EXPECT_GT(belief.stddev, 0);
}

// A fit whose matches say so.
PlaceFit found(double log_scale, double stddev) {
  PlaceFit fit;
  fit.scale = {log_scale, stddev};
  return fit;
}

TEST(KnownScale, IsTheOdometrysAndWideBeforeAFix) {
  const KnownScale scale(0.025, 1.5, 16);
  EXPECT_EQ(scale.expected().log_scale, 0);
  EXPECT_FALSE(scale.is_fitted());
  EXPECT_GT(scale.searched_stddev(false, false), 0.05);
  EXPECT_EQ(scale.searched_stddev(true, false), 0.025);
}

TEST(KnownScale, GoesBackToTheOdometrysWordTheLongerNothingIsFound) {
  KnownScale scale(0.025, 1.5, 16);
  scale.hear(0.003);
  scale.learn(found(0.1, 0.01));
  double before = scale.expected().log_scale;
  EXPECT_GT(before, 0.08);
  for (int k = 0; k < 12; ++k) {
    scale.missed();
    EXPECT_LE(scale.expected().log_scale, before + 1e-9);
    before = scale.expected().log_scale;
  }
  EXPECT_LT(before, 0.03);
  EXPECT_GT(scale.expected().stddev, 0.02) << "nobody has told for long";
}

TEST(KnownScale, TakesTheOdometrysWordIntoAccountOnce) {
  KnownScale scale(0.025, 1.5, 16);
  scale.hear(0.025);
  const PlaceFit fit = found(0.03, 0.02);
  const ScaleBelief after = scale.after_fit(fit);
  scale.learn(fit);
  EXPECT_NEAR(scale.expected().log_scale, after.log_scale, 1e-12);
  EXPECT_NEAR(scale.expected().stddev, after.stddev, 1e-12);
}

TEST(KnownScale, IsLookedForAnewWhereFewerPointsStayAligned) {
  KnownScale scale(0.025, 1.5, 16);
  scale.learn(found(0.0, 0.01));
  for (int k = 0; k < 50; ++k) scale.saw(0.6);
  EXPECT_LT(scale.searched_stddev(false, true), 0.05);
  scale.saw(0.2);
  EXPECT_GT(scale.searched_stddev(false, true), 0.05);
}

TEST(KnownScale, IsForgottenWithTheSession) {
  KnownScale scale(0.025, 1.5, 16);
  scale.learn(found(0.1, 0.01));
  scale.forget();
  EXPECT_FALSE(scale.is_fitted());
  EXPECT_EQ(scale.expected().log_scale, 0);
}

}  // namespace
}  // namespace orthonav::registration
