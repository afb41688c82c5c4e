#include "services/registration/submap/ground_level.h"

#include <cmath>
#include <random>
#include <vector>

#include <gtest/gtest.h>

#include "services/registration/submap/place_fit.h"
#include "tests/registration/synthetic_flight.h"

namespace orthonav::registration {
namespace {

constexpr double kHeight = 110, kPerObservation = 30;

class Scene {
 public:
  // Lifts of `on_ground` points of the ground and `above` points of a canopy some `tall` m high, of a body at `z`.
  std::vector<double> lifts(int on_ground, int above, double tall, double z) {
    std::vector<double> result;
    for (int i = 0; i < on_ground; ++i) result.push_back(z + noise_(random_));
    for (int i = 0; i < above; ++i) result.push_back(z - tall + noise_(random_));
    return result;
  }

 private:
  std::mt19937 random_{7};
  std::normal_distribution<double> noise_{0, 1};
};

Eigen::Vector3d at(double z, double x = 0) {
  return {x, 0, z};
}

TEST(GroundLevel, IsTheMeanOverBareGround) {
  Scene scene;
  GroundLevel ground;
  ground.add(scene.lifts(400, 0, 0, kHeight), kHeight, at(3), kPerObservation);
  EXPECT_NEAR(ground.level(), kHeight, 0.2);
}

TEST(GroundLevel, IsTheGroundWhereMostPointsLieOnAWood) {
  for (const double tall : {8.0, 12.0, 25.0}) {
    Scene scene;
    GroundLevel ground;
    ground.add(scene.lifts(60, 140, tall, kHeight), kHeight, at(0), kPerObservation);
    EXPECT_NEAR(ground.level(), kHeight, 0.6) << tall;
  }
}

TEST(GroundLevel, IsNotLiftedByAFewWrongPointsBelowTheGround) {
  Scene scene;
  GroundLevel ground;
  std::vector<double> lifts = scene.lifts(150, 0, 0, kHeight);
  const std::vector<double> wrong = scene.lifts(0, 12, -20, kHeight);
  lifts.insert(lifts.end(), wrong.begin(), wrong.end());
  ground.add(lifts, kHeight, at(0), kPerObservation);
  EXPECT_NEAR(ground.level(), kHeight, 0.3);
}

TEST(GroundLevel, IsRememberedOverAClosedWoodAndMovesWithTheBody) {
  constexpr double kApart = 2.6;  // m between keyframes
  Scene scene;
  GroundLevel ground;
  for (int i = 0; i < 20; ++i) ground.add(scene.lifts(120, 0, 0, kHeight), kHeight, at(5, kApart * i), kPerObservation);
  double z = 0;
  for (int i = 1; i <= 15; ++i) {
    z = 0.25 * i;
    ground.add(scene.lifts(3, 117, 11, kHeight + z), kHeight, at(5 + z, kApart * (20 + i)), kPerObservation);
  }
  EXPECT_NEAR(ground.level(), kHeight + z, 1.0);
}

TEST(GroundLevel, IsNotOutvotedByOneTreeSeenAgainAndAgain) {
  Scene scene;
  GroundLevel ground;
  ground.add(scene.lifts(120, 0, 0, kHeight), kHeight, at(0), kPerObservation);
  for (int i = 0; i < 100; ++i) ground.add(scene.lifts(3, 117, 11, kHeight), kHeight, at(0, 1), kPerObservation);
  EXPECT_NEAR(ground.level(), kHeight, 1.0);
}

TEST(GroundLevel, FollowsWhenTheWoodProvesToBeTheGround) {
  // The map's height or the odometry's was wrong by 6 m: what was remembered must give way.
  Scene scene;
  GroundLevel ground;
  for (int i = 0; i < 20; ++i) ground.add(scene.lifts(120, 0, 0, kHeight), kHeight, at(0, 3 * i), kPerObservation);
  for (int i = 0; i < 100; ++i) {
    ground.add(scene.lifts(120, 0, 0, kHeight - 6), kHeight, at(0, 60 + 3 * i), kPerObservation);
  }
  EXPECT_NEAR(ground.level(), kHeight - 6, 0.3);
}

TEST(GroundLevel, AveragesTheErrorsOfTheMapsHeights) {
  // An elevation model that errs by 1 m up and down every 150 m of way.
  constexpr double kApart = 2.6, kLength = 150;  // m
  Scene scene;
  GroundLevel ground;
  double squares = 0, here = 0;
  int count = 0;
  for (int i = 0; i < 400; ++i) {
    const double error = std::sin(2 * M_PI * kApart * i / kLength);
    ground.add(scene.lifts(120, 0, 0, kHeight + error), kHeight, at(0, kApart * i), kPerObservation);
    if (i < 100) continue;
    squares += (ground.level() - kHeight) * (ground.level() - kHeight);
    here += error * error;
    ++count;
  }
  EXPECT_LT(std::sqrt(squares / count), 0.4 * std::sqrt(here / count));
}

TEST(GroundLevel, MayLieLowerUntilMoreThanAWoodWasSeen) {
  Scene scene;
  GroundLevel ground;
  ground.add(scene.lifts(120, 0, 0, kHeight), kHeight, at(0), kPerObservation);
  EXPECT_GT(ground.hidden_stddev(), 5);
  for (int i = 0; i < 20; ++i) ground.add(scene.lifts(120, 0, 0, kHeight), kHeight, at(0), kPerObservation);
  EXPECT_GT(ground.hidden_stddev(), 5) << "hovering shows nothing new";
  for (int i = 1; i <= 20; ++i) ground.add(scene.lifts(120, 0, 0, kHeight), kHeight, at(0, 10 * i), kPerObservation);
  EXPECT_LT(ground.hidden_stddev(), 0.1);
}

// Levels 25 m too high, of a scale that was 25 % too long and sure of itself; then it is right.
TEST(GroundLevel, GivesWayWithTheFirstRightScaleAfterAWrongOne) {
  Scene scene;
  GroundLevel ground;
  const ScaleBelief wrong{0.22, 0.005}, right{0, 0.005};
  for (int i = 0; i < 40; ++i) {
    ground.add(scene.lifts(120, 0, 0, kHeight + 25), kHeight, at(0, 2.6 * i), kPerObservation, wrong);
  }
  ground.add(scene.lifts(120, 0, 0, kHeight), kHeight, at(0, 2.6 * 40), kPerObservation, right);
  EXPECT_NEAR(ground.level(), kHeight, 1.0);
}

// The same where the scale comes to it by steps that are all within what is said of it.
TEST(GroundLevel, GivesWayWhereTheScaleIsFoundStepByStep) {
  Scene scene;
  GroundLevel ground;
  for (int i = 0; i < 60; ++i) {
    const double off = 0.14 * std::max(0.0, 1 - i / 20.0);
    ground.add(scene.lifts(120, 0, 0, kHeight * (1 + off)), kHeight, at(0, 2.6 * i), kPerObservation,
               {std::log(1 + off), i < 20 ? 0.025 : 0.012});
  }
  EXPECT_NEAR(ground.level(), kHeight, 1.5);
}

TEST(GroundLevel, IsRememberedOverAWoodWhereTheScaleOnlyTrembles) {
  Scene scene;
  GroundLevel ground;
  const auto scale = [](int i) { return ScaleBelief{i % 2 == 0 ? 0.003 : -0.003, 0.005}; };
  for (int i = 0; i < 20; ++i) {
    ground.add(scene.lifts(120, 0, 0, kHeight), kHeight, at(0, 2.6 * i), kPerObservation, scale(i));
  }
  for (int i = 20; i < 35; ++i) {
    ground.add(scene.lifts(3, 117, 11, kHeight), kHeight, at(0, 2.6 * i), kPerObservation, scale(i));
  }
  EXPECT_NEAR(ground.level(), kHeight, 1.0);
}

// 285 m up, a start whose scale is a fifth too long or short is further off than the levels compared reach.
TEST(GroundLevel, BeginsAnewWhereWhatIsSeenLiesBeyondAllThatIsRemembered) {
  constexpr double kHigh = 285;
  for (const double off : {-0.2, 0.2}) {
    Scene scene;
    GroundLevel ground;
    for (int i = 0; i < 20; ++i) {
      ground.add(scene.lifts(120, 0, 0, kHigh * (1 + off)), kHigh, at(0, 5 * i), kPerObservation,
                 {std::log(1 + off), 0.01});
    }
    ground.add(scene.lifts(120, 0, 0, kHigh), kHigh, at(0, 5 * 20), kPerObservation, {0, 0.01});
    EXPECT_NEAR(ground.level(), kHigh, 1.0) << off;
  }
}

TEST(GroundLevel, IsTheMeanCloseToTheGroundToo) {
  Scene scene;
  GroundLevel ground;
  for (int i = 0; i < 20; ++i) ground.add(scene.lifts(120, 0, 0, 3), 3, at(0, 2 * i), kPerObservation);
  EXPECT_NEAR(ground.level(), 3, 0.3);
}

// A flight east, 100 m above ground that lies 20 m high in G: first over fields, then over a wood of 12 m.
std::vector<View> flight_onto_a_wood(int over_fields, int over_the_wood) {
  std::vector<View> views(static_cast<size_t>(over_fields + over_the_wood));  // newest first
  cv::RNG random(5);
  for (size_t k = 0; k < views.size(); ++k) {
    Keyframe& keyframe = views[k].keyframe;
    keyframe.p_W_B = {-20.0 * static_cast<double>(k), 0, 100};
    keyframe.height_above_ground = 100;
    const double top = static_cast<int>(k) < over_the_wood ? 12 : 0;
    for (int i = 0; i < 80; ++i) {
      Eigen::Vector3d p_W = keyframe.p_W_B;
      p_W += Eigen::Vector3d(random.uniform(-30.0, 30.0), random.uniform(-30.0, 30.0), 0);
      p_W.z() = top + random.gaussian(0.5);
      views[k].points.emplace_back().p_W = p_W;
    }
  }
  return views;
}

TEST(GroundAlong, AWoodUnderTheFirstFixIsToldFromTheFieldsBeforeIt) {
  const SyntheticFields fields{1};
  MapFeatures map = described_map(fields);
  for (Eigen::Vector3f& position : map.positions) position.z() = 20;
  const MapIndex index(std::move(map), kFieldsMap);
  PlaceFit fit;
  fit.en = index.place(index.rows() / 2, index.columns() * 3 / 4);
  const auto level = [&](int over_fields, int over_the_wood) {
    const std::vector<View> views = flight_onto_a_wood(over_fields, over_the_wood);
    std::vector<const View*> pointers;
    for (const View& view : views) pointers.push_back(&view);
    return ground_along(pointers, fit, {}, index, {}).level();
  };
  EXPECT_NEAR(level(5, 1), 120, 0.5);
  EXPECT_NEAR(level(3, 4), 120, 1.0);
  EXPECT_NEAR(level(0, 6), 108, 1.0);  // nothing but the wood was seen
}

}  // namespace
}  // namespace orthonav::registration
