#include "services/registration/place_belief.h"

#include <cmath>

#include <Eigen/Geometry>
#include <gtest/gtest.h>

#include "services/registration/place_prior.h"

namespace orthonav::registration {
namespace {

const Eigen::Matrix2d kG_W = 1.1 * Eigen::Rotation2Dd(0.5).toRotationMatrix();

// Over a grid of 1 m about the origin.
double integral(const ExpectedArea& area) {
  double sum = 0;
  for (int x = -400; x <= 400; ++x) {
    for (int y = -400; y <= 400; ++y) sum += area.density({x, y});
  }
  return sum;
}

TEST(PlaceBelief, OddsAreThoseAgainstAllOthersAndNone) {
  PlaceBelief belief;
  EXPECT_EQ(belief.none(), 1);
  belief.suppose({0, 0}, kG_W, 1, std::log(6.0));
  belief.suppose({100, 0}, kG_W, 1, std::log(2.0));
  belief.settle();
  ASSERT_EQ(belief.hypotheses().size(), 2u);
  const int64_t first = belief.hypotheses()[0].id, second = belief.hypotheses()[1].id;
  EXPECT_EQ(belief.hypotheses()[0].en, Eigen::Vector2d(0, 0)) << "the likeliest first";
  EXPECT_NEAR(belief.probability(first), 6.0 / 9, 1e-12);
  EXPECT_NEAR(belief.probability(second), 2.0 / 9, 1e-12);
  EXPECT_NEAR(belief.none(), 1.0 / 9, 1e-12);
  EXPECT_NEAR(belief.log_odds(first), std::log(2.0), 1e-12);
  EXPECT_EQ(belief.probability(12345), 0);
}

TEST(PlaceBelief, SaysOddsThatNoDoubleCouldHoldTheExponentialOf) {
  PlaceBelief belief;
  belief.suppose({0, 0}, kG_W, 1, 2000);
  belief.suppose({100, 0}, kG_W, 1, 1990);
  belief.settle();
  EXPECT_NEAR(belief.log_odds(belief.hypotheses()[0].id), 10, 1e-9);
  EXPECT_EQ(belief.none(), 0);
}

TEST(PlaceBelief, TheOdometryCarriesEveryPlaceAsItsWorldLies) {
  PlaceBelief belief;
  belief.carry({5, 5}, 0.1);
  belief.suppose({0, 0}, kG_W, 2, 1);
  belief.suppose({100, 0}, Eigen::Matrix2d::Identity(), 2, 1);
  belief.carry({35, 45}, 0.1);  // 50 m
  for (const PlaceHypothesis& each : belief.hypotheses()) {
    const bool is_first = each.G_W == kG_W;
    const Eigen::Vector2d begun = is_first ? Eigen::Vector2d(0, 0) : Eigen::Vector2d(100, 0);
    EXPECT_LT((each.en - begun - each.G_W * Eigen::Vector2d(30, 40)).norm(), 1e-9);
    EXPECT_NEAR(each.stddev, std::hypot(2, 0.1 * (is_first ? 55 : 50)), 1e-9);
  }
}

TEST(PlaceBelief, WhatIsFoundWhereAPlaceWasCarriedToIsThatPlace) {
  PlaceBelief belief;
  belief.suppose({0, 0}, kG_W, 2, 1);
  const int64_t id = belief.hypotheses()[0].id;
  belief.suppose({4, 0}, kG_W, 2, 5);
  ASSERT_EQ(belief.hypotheses().size(), 1u);
  EXPECT_EQ(belief.hypotheses()[0].id, id);
  EXPECT_EQ(belief.hypotheses()[0].log_odds, 5);
  EXPECT_NEAR(belief.hypotheses()[0].en.x(), 2, 1e-12) << "in the middle of two that are as sure";
  EXPECT_NEAR(belief.hypotheses()[0].stddev, std::sqrt(2.0), 1e-12);
  belief.suppose({40, 0}, kG_W, 2, 5);
  EXPECT_EQ(belief.hypotheses().size(), 2u) << "twelve standard deviations away is another place";
}

TEST(PlaceBelief, PlacesThatComeToAgreeAreOneAndNegligibleOnesAreDropped) {
  PlaceBelief belief;
  belief.suppose({0, 0}, kG_W, 1, 20);
  belief.suppose({100, 0}, kG_W, 1, 19);
  belief.suppose({200, 0}, kG_W, 1, -1);
  const int64_t second = belief.hypotheses()[1].id;
  for (int i = 0; i < 200; ++i) belief.correct(second, {0, 0}, kG_W, 1);
  belief.settle();
  ASSERT_EQ(belief.hypotheses().size(), 1u);
  EXPECT_EQ(belief.hypotheses()[0].log_odds, 20);
  for (int i = 0; i < 100; ++i) belief.suppose({1000.0 * i, 500}, kG_W, 1, 20);
  belief.settle();
  EXPECT_EQ(belief.hypotheses().size(), 16u) << "bounded";
  belief.clear();
  EXPECT_EQ(belief.none(), 1);
}

TEST(PlacePrior, AnAreaIsAProbability) {
  EXPECT_NEAR(integral({{{10, -20}}, 30, 1}), 1, 1e-3);
  EXPECT_NEAR(integral({{{-50, -60}, {90, -60}, {90, 40}, {-50, 40}}, 20, 1}), 1, 0.01);
  EXPECT_NEAR(integral({{{-50, -60}, {90, 40}, {-100, 80}}, 25, 1}), 1, 0.01) << "either way round";
  const ExpectedArea box{{{-50, -60}, {90, -60}, {90, 40}, {-50, 40}}, 20, 1};
  EXPECT_EQ(box.density({0, 0}), box.density({80, 30}));
  EXPECT_NEAR(box.density({110, 0}) / box.density({0, 0}), std::exp(-0.5), 1e-9) << "a standard deviation outside";
}

TEST(PlacePrior, EveryPlaceOfTheMapIsAsLikelyAndWhatIsExpectedOnlyAddsToIt) {
  PlacePrior prior(9, 90'000, 20);
  EXPECT_NEAR(prior.log_probability({3, 4}), -std::log(10'000.0 * 20), 1e-12);
  prior.expect({{{0, 0}}, 10, 0.9});
  EXPECT_NEAR(prior.log_probability({0, 0}), std::log(0.1 / 200'000 + 0.9 * 9 / 20 / (2 * M_PI * 100)), 1e-9);
  // Who is wrong for certain delays: the place needs ten times the odds, and no more.
  EXPECT_NEAR(prior.log_probability({2000, 0}), -std::log(10 * 200'000.0), 1e-9);
}

}  // namespace
}  // namespace orthonav::registration
