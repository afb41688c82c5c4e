#include "services/registration/held_place.h"

#include <Eigen/Geometry>
#include <gtest/gtest.h>

namespace orthonav::registration {
namespace {

constexpr double kTolerance = 15, kSpacing = 20;  // m
const Eigen::Matrix2d kG_W = 1.1 * Eigen::Rotation2Dd(0.5).toRotationMatrix();

// A flight east in W, 5 m from keyframe to keyframe, found where it is and `off` (m).
class HeldPlaceTest : public testing::Test {
 protected:
  void see_from(double x, const Eigen::Vector2d& off = {0, 0}) {
    const Eigen::Vector2d p_W(x, 0);
    held_.found(p_W, Eigen::Vector2d(1000, 2000) + kG_W * p_W + off, kG_W, kTolerance, kSpacing);
  }
  void fly(int keyframes, const Eigen::Vector2d& off = {0, 0}) {
    for (int i = 0; i < keyframes; ++i) see_from(x_ += 5, off);
  }
  double x_ = 0;  // m
  HeldPlace held_;
};

TEST_F(HeldPlaceTest, CountsTheNewGroundOfAPlaceThatMovesAsTheOdometryDoes) {
  EXPECT_EQ(held_.new_ground(), 0);
  fly(1);
  EXPECT_EQ(held_.new_ground(), 1);
  fly(20);  // 100 m
  EXPECT_EQ(held_.new_ground(), 6);
}

TEST_F(HeldPlaceTest, DoesNotCountTheSameGroundAgain) {
  fly(21);
  for (int lap = 0; lap < 10; ++lap) {
    for (double x = 0; x <= 105; x += 7) see_from(x);
  }
  EXPECT_EQ(held_.new_ground(), 6);
}

TEST_F(HeldPlaceTest, SurvivesOneKeyframeElsewhereThatItselfCountsNothing) {
  fly(21);
  fly(1, {40, 0});
  EXPECT_EQ(held_.new_ground(), 0);
  fly(1);
  EXPECT_EQ(held_.new_ground(), 6);
  held_.not_found();
  EXPECT_EQ(held_.new_ground(), 0);
  fly(1);
  EXPECT_EQ(held_.new_ground(), 6);
}

TEST_F(HeldPlaceTest, BeginsAnewAtTheSecondKeyframeElsewhere) {
  fly(21);
  fly(2, {40, 0});
  EXPECT_EQ(held_.new_ground(), 1);
  fly(4, {40, 0});
  EXPECT_EQ(held_.new_ground(), 2);
}

// From row to row of a field each step is small, and their sum another place.
TEST_F(HeldPlaceTest, IsNotWalkedAwayByStepsWithinTheTolerance) {
  fly(10);
  int lost = 0;
  for (int i = 1; i <= 10; ++i) {
    fly(1, {10.0 * i, 0});
    if (held_.new_ground() < 3) ++lost;
  }
  EXPECT_GT(lost, 0);
}

}  // namespace
}  // namespace orthonav::registration
