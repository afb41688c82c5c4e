#include "services/registration/place_message.h"

#include <limits>

#include <Eigen/Geometry>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

namespace orthonav::registration {
namespace {

using testing::HasSubstr;

const EnuFrame kFrame({48, 11, 500});
const double kNan = std::numeric_limits<double>::quiet_NaN();

position_hint_t about(double latitude_deg, double longitude_deg, double radius) {
  position_hint_t hint{};
  hint.latitude_deg = latitude_deg;
  hint.longitude_deg = longitude_deg;
  hint.radius = radius;
  return hint;
}

position_hint_t within(const std::vector<std::pair<double, double>>& corners) {
  position_hint_t hint = about(kNan, kNan, kNan);
  for (const auto& [latitude_deg, longitude_deg] : corners) {
    hint.corner_latitudes_deg.push_back(latitude_deg);
    hint.corner_longitudes_deg.push_back(longitude_deg);
  }
  hint.num_corners = static_cast<int32_t>(corners.size());
  return hint;
}

TEST(PositionHint, ARadiusHoldsNineteenOfTwentyPlaces) {
  const Geodetic there = kFrame.to_geodetic({300, -200, 0});
  const HintedArea hinted = area_of(about(there.latitude_deg, there.longitude_deg, 100), kFrame);
  ASSERT_EQ(hinted.problem, "");
  ASSERT_EQ(hinted.area.corners.size(), 1u);
  EXPECT_LT((hinted.area.corners[0] - Eigen::Vector2d(300, -200)).norm(), 0.1);
  double within = 0;
  for (int x = -300; x <= 300; ++x) {
    for (int y = -300; y <= 300; ++y) {
      if (std::hypot(x, y) <= 100) within += hinted.area.density(hinted.area.corners[0] + Eigen::Vector2d(x, y));
    }
  }
  EXPECT_NEAR(within, 0.95, 0.005);
}

TEST(PositionHint, AnAreaHasItsCornersInG) {
  const HintedArea hinted = area_of(within({{48, 11}, {48.001, 11}, {48.001, 11.002}}), kFrame);
  ASSERT_EQ(hinted.problem, "");
  ASSERT_EQ(hinted.area.corners.size(), 3u);
  EXPECT_LT((hinted.area.corners[2] - Eigen::Vector2d(149, 111.2)).norm(), 1);
}

TEST(PositionHint, WhatIsNoPlaceIsRefusedByName) {
  EXPECT_THAT(area_of(about(91, 11, 10), kFrame).problem, HasSubstr("latitude 91"));
  EXPECT_THAT(area_of(about(48, 181, 10), kFrame).problem, HasSubstr("longitude 181"));
  EXPECT_THAT(area_of(about(kNan, 11, 10), kFrame).problem, HasSubstr("nan"));
  for (const double radius : {0.0, -5.0, kNan, 1e9}) {
    EXPECT_THAT(area_of(about(48, 11, radius), kFrame).problem, HasSubstr("radius"));
  }
  EXPECT_THAT(area_of(within({{48, 11}, {48.001, 11}}), kFrame).problem, HasSubstr("2 corners"));
  EXPECT_THAT(area_of(within({{48, 11}, {48.001, 11}, {kNan, 11}}), kFrame).problem, HasSubstr("nan"));
}

TEST(PlaceHypotheses, SayWhereAndHowLikely) {
  PlaceBelief belief;
  const double yaw = 0.4;
  const Eigen::Matrix2d G_W = 1.05 * Eigen::Rotation2Dd(yaw).toRotationMatrix();
  belief.suppose({300, -200}, G_W, 3, 2);
  belief.suppose({-500, 100}, G_W, 5, 1);
  belief.settle();
  vio_keyframe_t keyframe{};
  keyframe.utime = 77;
  keyframe.session = 4;
  keyframe.q_W_B[0] = 1;  // the body's x axis lies along W's
  const place_hypotheses_t message = hypotheses_message(belief, keyframe, kFrame);
  EXPECT_EQ(message.utime, 77);
  EXPECT_EQ(message.session, 4);
  ASSERT_EQ(message.num_hypotheses, 2);
  const place_hypothesis_t& best = message.hypotheses[0];
  EXPECT_LT((kFrame.to_enu({best.latitude_deg, best.longitude_deg, 500}).head<2>() - Eigen::Vector2d(300, -200)).norm(),
            0.1);
  EXPECT_EQ(best.stddev, 3);
  EXPECT_NEAR(best.scale, 1.05, 1e-12);
  EXPECT_NEAR(best.heading, M_PI / 2 - yaw, 1e-9) << "clockwise from north";
  EXPECT_NEAR(best.probability + message.hypotheses[1].probability + message.none, 1, 1e-12);
}

}  // namespace
}  // namespace orthonav::registration
