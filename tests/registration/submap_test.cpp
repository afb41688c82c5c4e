#include "services/registration/submap/submap.h"

#include <algorithm>
#include <functional>
#include <limits>
#include <random>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "common/math/so3.h"
#include "tests/registration/synthetic_flight.h"

namespace orthonav::registration {
namespace {

using testing::HasSubstr;

class SubmapTest : public testing::Test {
 protected:
  Fix add(SubmapRegistrar& registrar, const Capture& capture, const Heading& heading,
          const std::optional<PositionPrior>& prior = {}, int session = 1) const {
    registrar.describe(capture.keyframe, session, capture.image, heading);
    registrar.search(prior);
    return registrar.solve();
  }
  SyntheticFields ground_{1};
};

// The same capture in a W that is turned by `angle`.
Capture in_another_world(Capture capture, double angle) {
  const Eigen::Matrix3d R = Eigen::AngleAxisd(angle, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  Keyframe& keyframe = capture.keyframe;
  keyframe.p_W_B = R * keyframe.p_W_B;
  keyframe.q_W_B = Eigen::Quaterniond(R) * keyframe.q_W_B;
  for (TrackedPoint& point : keyframe.points) point.p_W = R * point.p_W;
  return capture;
}

TEST_F(SubmapTest, WhatOneFixTaughtIsForgottenWhereNothingIsFoundUnderIt) {
  SubmapOptions options;
  options.max_keyframes = options.pose_keyframes = 1;
  SubmapRegistrar registrar(options, test_camera());
  registrar.set_map(described_map(ground_), kFieldsMap);
  const Capture capture = ground_.capture({95, -80, 60}, 0.3, 0.03, -0.04);
  ASSERT_TRUE(add(registrar, in_another_world(capture, 0.4), {0.3, 0.05}).valid);
  int misses = 0;
  while (misses < 20 && !add(registrar, capture, {0.3, 0.05}).valid) ++misses;
  EXPECT_GE(misses, 8);
  EXPECT_LT(misses, 14);
}

TEST_F(SubmapTest, EstimatesTheErrorsOfCompassAndScaleFromAnUnknownStart) {
  for (const double heading : {0.3, 2.0, 4.5}) {
    SubmapRegistrar registrar({}, test_camera());
    registrar.set_map(described_map(ground_), kFieldsMap);
    const double heading_error = 0.05, scale_error = 1.03;
    const Capture capture = ground_.capture({95, -80, 60}, heading, 0.03, -0.04, scale_error);
    const Fix fix = add(registrar, capture, {heading + heading_error, 0.05});
    ASSERT_TRUE(fix.valid) << fix.reason;
    const Eigen::Vector3d error = fix.p_G_B - capture.p_G_B;
    EXPECT_LT(error.head<2>().norm(), 0.5) << heading;
    // Few points of a small picture: the errors go down, to what the fix says they may be.
    // One keyframe does not tell a meadow from a wood twelve metres high; this is a meadow.
    const double height_stddev = std::sqrt(fix.covariance(2, 2) - 12 * 12);
    EXPECT_LT(std::abs(error.z()), 2.5 * height_stddev) << heading;
    EXPECT_LT(height_stddev, 2.0);
    // What the map's height errs by is the map's: neighbours share it, and it is not the matches' word.
    const double by_ground = std::sqrt(fix.covariance(2, 2) - fix.upright.covariance(2, 2));
    EXPECT_GT(by_ground, 0.8 * FitOptions().ground_height_stddev);
    EXPECT_LT(by_ground, 1.05 * FitOptions().ground_height_stddev);
    EXPECT_NEAR(fix.scale, 1 / scale_error, 2.5 * fix.scale_stddev);
    EXPECT_LT(fix.scale_stddev, 0.025);
    EXPECT_NEAR(fix.heading_correction, -heading_error, 2.5 * fix.heading_correction_stddev);
    EXPECT_LT(fix.heading_correction_stddev, 0.035);
    EXPECT_LT(fix.q_G_B.angularDistance(capture.q_G_B), 0.015);
    EXPECT_TRUE(std::isinf(fix.search_radius));
    // What the evaluation takes a fix to imply, too.
    const Eigen::Matrix3d R_G_W =
        rotation_G_W(capture.keyframe.q_W_B, heading + heading_error + fix.heading_correction);
    EXPECT_LT(((R_G_W * capture.keyframe.p_W_B).head<2>() + fix.translation - fix.p_G_B.head<2>()).norm(), 1e-6);
  }
}

// The same capture of an odometry whose world is `factor` times as large.
Capture scaled(Capture capture, double factor) {
  Keyframe& keyframe = capture.keyframe;
  keyframe.p_W_B *= factor;
  keyframe.height_above_ground *= factor;
  for (TrackedPoint& point : keyframe.points) point.p_W *= factor;
  return capture;
}

TEST_F(SubmapTest, FollowsAnOdometryThatIsFarTooLongOrShort) {
  for (const double factor : {0.85, 0.9, 1.1, 1.15}) {
    SubmapRegistrar registrar({}, test_camera());
    registrar.set_map(described_map(ground_), kFieldsMap);
    Fix fix;
    Capture capture;
    for (int i = 0, fixes = 0; i < 13 && fixes < 11; ++i) {
      capture = scaled(ground_.capture({40.0 + 10 * i, -80, 60}, 1.0, 0.03, -0.04), factor);
      capture.keyframe.scale_stddev = 0.003;  // as it says of itself
      fix = add(registrar, capture, capture.heading, PositionPrior{capture.p_G_B.head<2>(), 2});
      fixes += fix.valid ? 1 : 0;
      if (fixes < 2 || !fix.valid) continue;
      EXPECT_NEAR(std::log(fix.scale * factor), 0, 3 * fix.scale_stddev) << factor << ", keyframe " << i;
    }
    ASSERT_TRUE(fix.valid) << fix.reason;
    EXPECT_NEAR(fix.scale * factor, 1, 0.01) << factor;
    EXPECT_LT(fix.scale_stddev, 0.025) << factor;
    const double height_stddev = std::sqrt(fix.covariance(2, 2));
    EXPECT_LT(std::abs(fix.p_G_B.z() - capture.p_G_B.z()), 2.5 * height_stddev) << factor;
    EXPECT_LT(height_stddev, 2) << factor;  // an echo would be 6 m and more off
  }
}

// The same capture of an odometry whose vertical is turned by `angle` (rad about W's axes).
Capture leaning(Capture capture, const Eigen::Vector3d& angle) {
  const Eigen::Matrix3d R = so3_exp(angle).toRotationMatrix();
  Keyframe& keyframe = capture.keyframe;
  keyframe.q_W_B = Eigen::Quaterniond(R) * keyframe.q_W_B;
  for (TrackedPoint& point : keyframe.points) point.p_W = keyframe.p_W_B + R * (point.p_W - keyframe.p_W_B);
  return capture;
}

TEST_F(SubmapTest, AFixSaysWhereItWouldBeUnderAnotherVertical) {
  const double lean = 0.02;
  for (const Eigen::Vector3d& angle :
       {Eigen::Vector3d(lean, 0, 0), Eigen::Vector3d(-lean, 0, 0), Eigen::Vector3d(0, lean, 0)}) {
    SubmapRegistrar registrar({}, test_camera());
    registrar.set_map(described_map(ground_), kFieldsMap);
    const Capture upright = ground_.capture({95, -80, 60}, 1.0, 0.03, -0.04);
    const Capture capture = leaning(upright, angle);
    const Fix fix = add(registrar, capture, capture.heading, PositionPrior{{95, -80}, 2});
    ASSERT_TRUE(fix.valid) << fix.reason;
    // Turns what the odometry takes for vertical back to what is.
    const Eigen::Matrix3d R_G_W = (upright.q_G_B * upright.keyframe.q_W_B.inverse()).toRotationMatrix();
    const Eigen::Vector2d tilt = (R_G_W * -angle).head<2>();
    const Eigen::Vector2d leant = (fix.upright.p_G_B - capture.p_G_B).head<2>();
    const Eigen::Vector2d put_right = (fix.upright.p_G_B - fix.upright.lever * tilt - capture.p_G_B).head<2>();
    EXPECT_GT(leant.norm(), 0.9 * lean * 60) << angle.transpose();
    EXPECT_LT(put_right.norm(), 0.3 * lean * 60) << angle.transpose();
    EXPECT_LT((fix.upright.tilt - tilt).norm(), 0.2 * lean) << "the ground is level";
    // A body 60 m above what it sees straight below it.
    Eigen::Matrix2d lever;
    lever << 0, -60, 60, 0;
    EXPECT_LT((fix.upright.lever.topRows<2>() - lever).norm(), 10);
  }
}

TEST_F(SubmapTest, APointTriangulatedFarBelowTheGroundChangesNothing) {
  SubmapRegistrar registrar({}, test_camera()), other({}, test_camera());
  registrar.set_map(described_map(ground_), kFieldsMap);
  other.set_map(described_map(ground_), kFieldsMap);
  const Capture capture = ground_.capture({95, -80, 60}, 1.0, 0.03, -0.04);
  Capture far = capture;
  far.keyframe.points.push_back(far.keyframe.points.front());
  far.keyframe.points.back().p_W += 200 * (far.keyframe.points.back().p_W - far.keyframe.p_W_B);
  const PositionPrior prior{{97, -77}, 2};
  EXPECT_EQ(add(registrar, far, far.heading, prior).p_G_B, add(other, capture, capture.heading, prior).p_G_B);
}

TEST_F(SubmapTest, PointsThatCannotBeMeantAreLeftOutAndCountedAndCostNoMemory) {
  const Capture capture = ground_.capture({95, -80, 60}, 1.0, 0.03, -0.04);
  const double nan = std::numeric_limits<double>::quiet_NaN();
  struct Bad {
    const char* name;
    std::function<void(TrackedPoint&)> spoil;
    bool contradicted;
  };
  const Eigen::Vector3d body = capture.keyframe.p_W_B;
  const std::vector<Bad> kinds{
      {"ten kilometres away along its ray", [&](TrackedPoint& p) { p.p_W = body + 170 * (p.p_W - body); }, true},
      {"ten kilometres to the side", [&](TrackedPoint& p) { p.p_W += Eigen::Vector3d(1e4, 0, 0); }, true},
      {"beyond all numbers", [&](TrackedPoint& p) { p.p_W = 1e200 * Eigen::Vector3d::Ones(); }, true},
      {"of no place", [&](TrackedPoint& p) { p.p_W.x() = nan; }, false},
      {"of no direction", [&](TrackedPoint& p) { p.ray_C.setZero(); }, false},
      {"behind the camera", [&](TrackedPoint& p) { p.ray_C = -p.ray_C; }, false}};
  for (const Bad& bad : kinds) {
    for (const size_t every : {size_t{100}, size_t{4}}) {
      Capture spoilt = capture, clean = capture;
      clean.keyframe.points.clear();
      for (size_t i = 0; i < capture.keyframe.points.size(); ++i) {
        if (i % every == 0) {
          bad.spoil(spoilt.keyframe.points[i]);
        } else {
          clean.keyframe.points.push_back(capture.keyframe.points[i]);
        }
      }
      SubmapRegistrar registrar({}, test_camera()), other({}, test_camera());
      registrar.set_map(described_map(ground_), kFieldsMap);
      other.set_map(described_map(ground_), kFieldsMap);
      const Fix fix = add(registrar, spoilt, spoilt.heading), without = add(other, clean, clean.heading);
      EXPECT_EQ(fix.p_G_B, without.p_G_B) << bad.name;
      EXPECT_EQ(fix.log_odds, without.log_odds) << bad.name;
      EXPECT_EQ(fix.num_contradicted > 0, bad.contradicted) << bad.name;
    }
  }
}

TEST(Alignments, AreCoarserRatherThanWithoutEnd) {
  for (const double lever : {100.0, 1e4, 1e9, 1e300, std::numeric_limits<double>::infinity()}) {
    const auto all = alignments({0, 1}, 0.05, 0.15, lever, 6);
    EXPECT_GE(all.size(), 1u) << lever;
    EXPECT_LE(all.size(), 2000u) << lever;
  }
  EXPECT_GT(alignments({0, 1}, 0.05, 0.15, 1e4, 6).size(), 1000u);
}

TEST_F(SubmapTest, ACompassesBiasIsLeftBehindFixByFix) {
  SubmapRegistrar registrar({}, test_camera());
  registrar.set_map(described_map(ground_), kFieldsMap);
  const double bias = 0.1;  // rad: twice what the compass says of itself
  std::vector<double> errors;
  for (int i = 0; i < 8; ++i) {
    const Capture capture = ground_.capture({60.0 + 6 * i, -80, 60}, 1.0, 0.03, -0.04);
    const Fix fix = add(registrar, capture, {1.0 + bias, 0.05});
    if (fix.valid) errors.push_back(std::abs(bias + fix.heading_correction));
  }
  ASSERT_GE(errors.size(), 6u);
  EXPECT_LT(errors.back(), 0.01);
  EXPECT_LT(errors.back(), 0.5 * errors.front());
}

// Nearly four of the compass's standard deviations off. On the tests' ground a place is clear all the same; where more
// is asked of it, it is only so under the right heading.
TEST_F(SubmapTest, AHeadingFurtherOffThanTheCompassSaysIsLookedForWhereTheCompassShowsNoClearPlace) {
  const Capture capture = ground_.capture({95, -80, 60}, 1.0, 0.03, -0.04);
  for (const double heading_error : {0.19, -0.19}) {
    const auto sure_at = [&](double probability, double error) {
      SubmapOptions options;
      options.probability = probability;
      SubmapRegistrar registrar(options, test_camera());
      registrar.set_map(described_map(ground_), kFieldsMap);
      return add(registrar, capture, {1.0 + error, 0.05});
    };
    const double right = sure_at(0, 0).log_odds;
    const double believed = sure_at(0, heading_error).log_odds;
    ASSERT_LT(believed, 0.8 * right);
    const Fix fix = sure_at(1 / (1 + std::exp(-0.5 * (right + believed))), heading_error);
    ASSERT_TRUE(fix.valid) << fix.reason;
    EXPECT_GT(fix.log_odds, believed);
    EXPECT_NEAR(fix.heading_correction, -heading_error, 2.5 * fix.heading_correction_stddev);
    EXPECT_LT((fix.p_G_B - capture.p_G_B).head<2>().norm(), 0.5);
  }
}

TEST_F(SubmapTest, FindsTheHeadingWhereNoneIsKnown) {
  SubmapOptions options;
  options.search_heading = true;
  SubmapRegistrar registrar(options, test_camera());
  registrar.set_map(described_map(ground_), kFieldsMap);
  const Capture capture = ground_.capture({95, -80, 60}, 1.0, 0.03, -0.04);
  const Fix fix = add(registrar, capture, {1.0 + 2.5, 0.05});
  ASSERT_TRUE(fix.valid) << fix.reason;
  EXPECT_LT((fix.p_G_B - capture.p_G_B).norm(), 1.0);
  EXPECT_NEAR(fix.heading_correction, -2.5, 0.03);
}

TEST_F(SubmapTest, FindsTheHeadingWhereThereIsNoCompassAndGoesOnWhenItComesAndFails) {
  SubmapRegistrar registrar({}, test_camera());
  registrar.set_map(described_map(ground_), kFieldsMap);
  const Heading none, off{1.0 - 0.1, 0.05};
  int k = 0;
  for (const Heading& compass : {none, none, off, off, none, none}) {
    const Capture capture = ground_.capture({60.0 + 10 * k++, -80, 60}, 1.0, 0.03, -0.04);
    const Fix fix = add(registrar, capture, compass);
    if (k == 1 && !fix.valid) continue;  // of 24 headings one keyframe of 80 points need not make one sure
    ASSERT_TRUE(fix.valid) << k << ": " << fix.reason;
    EXPECT_LT((fix.p_G_B - capture.p_G_B).head<2>().norm(), 1.0) << k;
    EXPECT_NEAR(wrap_angle(compass.value + fix.heading_correction - 1.0), 0, 0.03) << k;
  }
}

TEST_F(SubmapTest, LeavesTheHeadingOfACompassThatIsFarOffBehind) {
  for (const double off : {-0.35, 0.35}) {
    SubmapRegistrar registrar({}, test_camera());
    registrar.set_map(described_map(ground_), kFieldsMap);
    Fix fix;
    Capture capture;
    for (int k = 0; k < 6 && !fix.valid; ++k) {
      capture = ground_.capture({60.0 + 10 * k, -80, 60}, 1.0, 0.03, -0.04);
      fix = add(registrar, capture, {1.0 + off, 0.05});
    }
    ASSERT_TRUE(fix.valid) << fix.reason;
    EXPECT_LT((fix.p_G_B - capture.p_G_B).head<2>().norm(), 1.0) << off;
    EXPECT_NEAR(fix.heading_correction, -off, 0.03);
  }
}

TEST_F(SubmapTest, TheMoreKeyframesTheSurer) {
  SubmapRegistrar registrar({}, test_camera());
  registrar.set_map(described_map(ground_), kFieldsMap);
  std::vector<double> ratios;
  for (int i = 0; i < 4; ++i) {
    const Capture capture = ground_.capture({70.0 + 12 * i, -80, 60}, 1.0, 0.03, -0.04);
    const Fix fix = add(registrar, capture, capture.heading);
    EXPECT_EQ(fix.num_keyframes, i + 1);
    EXPECT_LT((fix.p_G_B - capture.p_G_B).head<2>().norm(), 0.5);
    ratios.push_back(fix.log_likelihood_ratio);
  }
  EXPECT_GT(ratios.back(), 2 * ratios.front());
  // Another session is another world: nothing of the last one is held against it.
  const Capture capture = ground_.capture({60, -60, 60}, 2.0, 0.03, -0.04);
  EXPECT_EQ(add(registrar, capture, capture.heading, {}, 2).num_keyframes, 1);
}

// Of the newest image a sixth is ground, eight metres from where the odometry says it is seen; the rest is noise.
TEST_F(SubmapTest, WhereLittleOfTheNewestKeyframeFitsTheWholeSubmapHasToAgree) {
  const auto last_fix = [&](int max_keyframes) {
    SubmapOptions options;
    options.pose_keyframes = 1;
    options.max_keyframes = max_keyframes;
    SubmapRegistrar registrar(options, test_camera());
    registrar.set_map(described_map(ground_), kFieldsMap);
    for (int i = 0; i < 5; ++i) {
      const Capture capture = ground_.capture({50.0 + 12 * i, -80, 60}, 1.0, 0.03, -0.04);
      EXPECT_TRUE(add(registrar, capture, capture.heading).valid);
    }
    Capture capture = ground_.capture({110, -80, 60}, 1.0, 0.03, -0.04);
    const cv::Mat seen = ground_.capture({110, -88, 60}, 1.0, 0.03, -0.04).image;
    cv::RNG(7).fill(capture.image, cv::RNG::UNIFORM, 0, 256);
    const cv::Rect middle(94, 70, 131, 98);
    seen(middle).copyTo(capture.image(middle));
    return add(registrar, capture, capture.heading, PositionPrior{{110, -84}, 2});
  };
  const Fix alone = last_fix(1);
  ASSERT_TRUE(alone.valid) << alone.reason;
  EXPECT_NEAR(alone.p_G_B.y(), -88, 1.5);
  const Fix fix = last_fix(6);
  EXPECT_FALSE(fix.valid);
  EXPECT_THAT(fix.reason, HasSubstr("the whole submap"));
}

TEST_F(SubmapTest, BeginsAnewWhereNothingIsSeenAgain) {
  SubmapRegistrar registrar({}, test_camera());
  registrar.set_map(described_map(ground_), kFieldsMap);
  int id = 0;
  const auto fly = [&](int renamed, int step = 1) {
    Capture next = ground_.capture({80.0 + 3 * id, -80, 60}, 1.0, 0, 0);
    next.keyframe.id = id += step;
    for (size_t i = 0; i < next.keyframe.points.size(); ++i) {
      if (static_cast<int>(i) < renamed) next.keyframe.points[i].id += 1000 * id;
    }
    return add(registrar, next, {1.0, 0.05}).num_keyframes;
  };
  for (int k = 0; k < 4; ++k) fly(0);
  EXPECT_EQ(fly(10), 5) << "some points are seen again";
  EXPECT_EQ(fly(1000), 1);
  EXPECT_EQ(fly(1000, 2), 2) << "what links them did not arrive";
}

// What older keyframes saw lies where the odometry has carried it, and fits there: the newest one's is another's.
TEST_F(SubmapTest, AKeyframeWhoseOwnGroundDoesNotLookLikeThePlaceIsNoFix) {
  SubmapRegistrar registrar({}, test_camera());
  registrar.set_map(described_map(ground_), kFieldsMap);
  for (int k = 0; k < 6; ++k) {
    const Fix fix = add(registrar, ground_.capture({80.0 + 2 * k, -80, 60}, 1.0, 0, 0), {1.0, 0.05});
    EXPECT_TRUE(fix.valid) << fix.reason;
  }
  for (uint64_t seed = 50; seed < 60; ++seed) {
    Capture capture = ground_.capture({92, -80, 60}, 1.0, 0, 0);
    capture.image = SyntheticFields(seed).capture({92, -80, 60}, 1.0, 0, 0).image;
    EXPECT_FALSE(add(registrar, capture, {1.0, 0.05}).valid) << seed;
  }
}

TEST_F(SubmapTest, KeepsOfTheOlderKeyframesThoseThatSawNewGround) {
  SubmapRegistrar registrar({}, test_camera());
  registrar.set_map(described_map(ground_), kFieldsMap);
  const auto keyframes_after = [&](int count, double step, int session) {
    Capture capture;
    for (int i = 0; i < count; ++i) {
      capture = ground_.capture({40 + step * i, -80, 60}, 1.0, 0.03, -0.04);
      registrar.describe(capture.keyframe, session, capture.image, capture.heading);
    }
    registrar.search({});
    return registrar.solve().num_keyframes;
  };
  EXPECT_EQ(keyframes_after(20, 0, 1), 5);  // hovering: the newest four, and one
  // Every twelve metres one, and the newest four.
  const int flying = keyframes_after(50, 2, 2);
  EXPECT_GE(flying, 11);
  EXPECT_LE(flying, 13);
}

TEST_F(SubmapTest, IsAlignedOverTheWholeLengthOfTheSubmap) {
  std::vector<double> ratios;
  for (const double heading_error : {0.0, 0.08}) {  // the latter moves the far end by eight metres
    SubmapRegistrar registrar({}, test_camera());
    registrar.set_map(described_map(ground_), kFieldsMap);
    Capture capture;
    for (int i = 0; i < 10; ++i) {
      capture = ground_.capture({40.0 + 11 * i, -80, 60}, 1.0, 0.03, -0.04);
      registrar.describe(capture.keyframe, 1, capture.image, {1.0 + heading_error, 0.05});
    }
    registrar.search({});
    const Fix fix = registrar.solve();
    ASSERT_TRUE(fix.valid) << fix.reason;
    EXPECT_LT((fix.p_G_B - capture.p_G_B).head<2>().norm(), 0.7) << heading_error;
    ratios.push_back(fix.log_likelihood_ratio);
  }
  EXPECT_GT(ratios.back(), 0.5 * ratios.front());
}

TEST_F(SubmapTest, SearchesAroundTheExpectedPlaceAndWidensWhenItIsNotThere) {
  SubmapRegistrar registrar({}, test_camera());
  registrar.set_map(described_map(ground_), kFieldsMap);
  const Capture capture = ground_.capture({95, -80, 60}, 1.0, 0.03, -0.04);
  const Fix near = add(registrar, capture, capture.heading, PositionPrior{{97, -77}, 2});
  ASSERT_TRUE(near.valid) << near.reason;
  EXPECT_LT((near.p_G_B - capture.p_G_B).head<2>().norm(), 0.5);
  EXPECT_EQ(near.search_radius, 15);
  // The expectation goes astray. Never a fix there, and then one where the aircraft is.
  SubmapRegistrar lost({}, test_camera());
  lost.set_map(described_map(ground_), kFieldsMap);
  const PositionPrior astray{{55, -120}, 2};
  Fix found;
  int tries = 0;
  for (; tries < 10; ++tries) {
    found = add(lost, capture, capture.heading, astray);
    if (!found.valid) continue;
    EXPECT_LT((found.p_G_B - capture.p_G_B).head<2>().norm(), 0.5);
    EXPECT_GT(found.search_radius, 15);
    break;
  }
  EXPECT_GT(tries, 0);
  ASSERT_LT(tries, 10);
  // The search stays as wide until the expectation has come to what was found.
  for (int again = 0; again < 3; ++again) {
    const Fix fix = add(lost, capture, capture.heading, astray);
    EXPECT_TRUE(fix.valid) << fix.reason;
    EXPECT_EQ(fix.search_radius, found.search_radius);
    EXPECT_LT((fix.p_G_B - capture.p_G_B).head<2>().norm(), 0.5);
  }
  EXPECT_TRUE(add(lost, capture, capture.heading, PositionPrior{{97, -77}, 2}).valid);
  EXPECT_EQ(add(lost, capture, capture.heading, PositionPrior{{97, -77}, 2}).search_radius, 15);
}

TEST_F(SubmapTest, WhatLiesInTheWidenedPartOfASearchStandsAgainstTheWholeMapAndIsLessSure) {
  const Capture capture = ground_.capture({95, -80, 60}, 1.0, 0.03, -0.04);
  const auto seen_twice = [&](const Eigen::Vector2d& expected) {
    SubmapOptions strict;  // accepts nothing
    strict.min_inliers = 10'000;
    SubmapRegistrar registrar(strict, test_camera());
    registrar.set_map(described_map(ground_), kFieldsMap);
    add(registrar, capture, capture.heading, PositionPrior{expected, 2});
    const Fix fix = add(registrar, capture, capture.heading, PositionPrior{expected, 2});
    EXPECT_LT((registrar.belief().hypotheses().front().en - Eigen::Vector2d(95, -80)).norm(), 9) << "three cells";
    return fix;
  };
  const Fix here = seen_twice({97, -82}), wider = seen_twice({95, -59});  // 21 m off, 15 m are searched
  EXPECT_EQ(here.search_radius, 22.5);
  EXPECT_TRUE(std::isinf(wider.search_radius)) << "what is not expected has to stand against the whole map";
  EXPECT_LT(wider.log_odds, here.log_odds - 3);
}

TEST_F(SubmapTest, AHintMakesAPlaceSurerAndAWrongOneOnlyDelaysIt) {
  const auto odds = [&](const std::optional<ExpectedArea>& hint) {
    SubmapRegistrar registrar({}, test_camera());
    registrar.set_map(described_map(ground_), kFieldsMap);
    if (hint) registrar.hint(*hint);
    std::vector<double> all;
    for (int i = 0; i < 4; ++i) {
      const Capture capture = ground_.capture({70.0 + 10 * i, -80, 60}, 1.0, 0.03, -0.04);
      const Fix fix = add(registrar, capture, capture.heading);
      EXPECT_LT((registrar.belief().hypotheses().front().en - capture.p_G_B.head<2>()).norm(), 5) << i;
      all.push_back(fix.log_odds);
      if (fix.valid) break;
    }
    EXPECT_GT(all.back(), std::log(999.0)) << "found in the end";
    return all;
  };
  const std::vector<double> none = odds({}), right = odds(ExpectedArea{{{75, -70}}, 20, 0.9}),
                            wrong = odds(ExpectedArea{{{2075, -70}}, 20, 0.9});
  EXPECT_GT(right.front(), none.front() + 1);
  EXPECT_NEAR(wrong.front(), none.front() - std::log(10.0), 1e-6);
}

TEST_F(SubmapTest, LessToSeeMakesNoPlaceSurer) {
  const auto odds = [&](size_t part, int keyframes) {
    SubmapOptions strict;
    strict.min_inliers = 10'000;
    SubmapRegistrar registrar(strict, test_camera());
    registrar.set_map(described_map(ground_), kFieldsMap);
    Fix fix;
    for (int i = 4 - keyframes; i < 4; ++i) {
      Capture capture = ground_.capture({70.0 + 12 * i, -80, 60}, 1.0, 0.03, -0.04);
      capture.keyframe.points.resize(capture.keyframe.points.size() / part);
      fix = add(registrar, capture, capture.heading);
    }
    return fix.log_odds;
  };
  const double all = odds(1, 4);
  EXPECT_GT(all, std::log(999.0));
  EXPECT_LT(odds(2, 4), all);
  EXPECT_LT(odds(3, 4), odds(2, 4));
  EXPECT_LT(odds(1, 3), all);
  EXPECT_LT(odds(1, 2), odds(1, 3));
}

// What is no place of the map: another ground (above), the map in a mirror, an image of noise.
TEST_F(SubmapTest, IsNotSureOverAMirroredMapNorOfNoise) {
  std::mt19937 random(5);
  for (const bool noise : {false, true}) {
    SubmapRegistrar registrar({}, test_camera());
    MapFeatures features = described_map(ground_);
    if (!noise) {
      cv::Mat mirrored;
      cv::flip(ground_.picture(), mirrored, 1);
      std::vector<cv::Point2f> points;
      for (const Eigen::Vector3f& p : features.positions)
        points.emplace_back(p.x() / 0.3F - 0.5F, -p.y() / 0.3F - 0.5F);
      features.descriptors = OrientationField(mirrored, {.keypoint_size = 12}).describe(points);
    }
    registrar.set_map(std::move(features), kFieldsMap);
    for (int i = 0; i < 6; ++i) {
      Capture capture = ground_.capture({60.0 + 10 * i, -70, 60}, 1.0, 0.03, -0.04);
      if (noise) {
        for (int row = 0; row < capture.image.rows; ++row) {
          for (int column = 0; column < capture.image.cols; ++column) {
            capture.image.at<uchar>(row, column) = static_cast<uchar>(random() % 256);
          }
        }
        cv::GaussianBlur(capture.image, capture.image, {}, 2);
      }
      const Fix fix = add(registrar, capture, capture.heading);
      EXPECT_FALSE(fix.valid) << noise << " " << i;
      EXPECT_GT(registrar.belief().none(), 0.1) << noise << " " << i;
    }
  }
}

TEST_F(SubmapTest, IsNotSureOnAnotherGround) {
  SubmapRegistrar registrar({}, test_camera());
  registrar.set_map(described_map(ground_), kFieldsMap);
  for (int i = 0; i < 4; ++i) {
    const Capture capture = SyntheticFields(77).capture({70.0 + 12 * i, -80, 60}, 1.0, 0.03, -0.04);
    const Fix fix = add(registrar, capture, capture.heading);
    EXPECT_FALSE(fix.valid);
    EXPECT_FALSE(fix.reason.empty());
  }
}

TEST_F(SubmapTest, PassesOnWhyAKeyframeWasRefusedAndGoesOn) {
  SubmapRegistrar registrar({}, test_camera());
  EXPECT_THROW(registrar.describe({}, 1, {}, {}), std::logic_error);
  registrar.set_map(described_map(ground_), kFieldsMap);
  const Capture good = ground_.capture({95, -80, 60}, 1.0, 0.03, -0.04);
  const auto reason = [&](const Capture& capture, const Heading& heading) {
    const Fix fix = add(registrar, capture, heading);
    EXPECT_FALSE(fix.valid);
    return fix.reason;
  };
  EXPECT_THAT(reason(good, {NAN, 0.05}), HasSubstr("heading"));
  Capture bad = good;
  bad.keyframe.height_above_ground = -1;
  EXPECT_THAT(reason(bad, bad.heading), HasSubstr("height"));
  bad = good;
  bad.keyframe.p_W_B.x() = NAN;
  EXPECT_THAT(reason(bad, bad.heading), HasSubstr("pose"));
  bad = good;
  for (TrackedPoint& point : bad.keyframe.points) point.p_W.z() = NAN;
  EXPECT_THAT(reason(bad, bad.heading), HasSubstr("0 usable points"));
  bad = good;
  bad.image = cv::Mat(20, 20, CV_8U, cv::Scalar(9));
  EXPECT_THAT(reason(bad, bad.heading), HasSubstr("20 x 20"));
  bad = good;
  bad.image = cv::Mat(good.image.size(), CV_8U, cv::Scalar(100));
  EXPECT_THAT(reason(bad, bad.heading), HasSubstr("usable points"));
  const Fix fix = add(registrar, good, good.heading, PositionPrior{{NAN, 0}, 1});
  EXPECT_TRUE(fix.valid) << fix.reason;
  EXPECT_TRUE(std::isinf(fix.search_radius));
}

}  // namespace
}  // namespace orthonav::registration
