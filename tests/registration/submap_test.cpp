#include "services/registration/submap.h"

#include <algorithm>
#include <limits>
#include <random>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "common/features/orientation_field.h"
#include "services/registration/dot_products.h"
#include "tests/registration/synthetic_flight.h"

namespace orthonav::registration {
namespace {

using testing::HasSubstr;

const MapGeometry kMap{SyntheticFields::kSigma, 12, 10};

TEST(DotProducts, AreThoseOfTheDefinitionWhateverTheWidth) {
  cv::RNG random(3);
  cv::Mat bytes(200, kSiftBytes, CV_8U);
  random.fill(bytes, cv::RNG::UNIFORM, 0, 256);
  for (int i = 0; i + 1 < bytes.rows; ++i) {
    int64_t expected = 0;
    for (int k = 0; k < kSiftBytes; ++k) expected += bytes.at<uchar>(i, k) * bytes.at<uchar>(i + 1, k);
    EXPECT_EQ(dot_product(bytes.ptr(i), bytes.ptr(i + 1)), expected);
  }
  const std::vector<int> which{7, -1, 0, 199};
  std::vector<int> found(which.size());
  dot_products(bytes.ptr(3), bytes.ptr(), which.data(), which.size(), found.data());
  for (size_t i = 0; i < which.size(); ++i) {
    EXPECT_EQ(found[i], which[i] < 0 ? 0 : dot_product(bytes.ptr(3), bytes.ptr(which[i])));
  }
  for (const int columns : {1, 63, 64, 65, 200}) {
    cv::Mat row(kCoarseBytes / 2, 2 * columns, CV_8U);
    random.fill(row, cv::RNG::UNIFORM, 0, 46);  // 32 products of at most 45 * 22 fit
    cv::Mat query(1, kCoarseBytes, CV_8U);
    random.fill(query, cv::RNG::UNIFORM, 0, 23);
    const int first = columns / 3;
    std::vector<uint16_t> products(static_cast<size_t>(columns - first));
    coarse_products(query.ptr(), row.ptr() + static_cast<ptrdiff_t>(2 * first), static_cast<size_t>(columns),
                    products.size(), products.data());
    for (int i = first; i < columns; ++i) {
      int expected = 0;
      for (int k = 0; k < kCoarseBytes; ++k) {
        expected += query.at<uchar>(0, k) * row.at<uchar>(k / 2, 2 * i + k % 2);
      }
      EXPECT_EQ(products[static_cast<size_t>(i - first)], expected) << columns;
    }
  }
}

TEST(DotProducts, WhatTheySayAndItsSumsAreThoseOfTheDefinitionWhateverTheWidth) {
  std::mt19937 random(5);
  std::uniform_int_distribution<int> word(0, 30000), byte(0, 255);
  std::uniform_real_distribution<float> real(0.0F, 1.0F);
  const EvidenceLine line{15000, 0.01F, 0.5F, 4};
  const float levels = 255 / 16.0F;
  for (const size_t count : {0, 1, 15, 16, 33, 200}) {
    std::vector<uint16_t> products(count), words(count), more(count), most(count), sums;
    std::vector<uint8_t> bytes(count), weights(count);
    std::vector<float> scales(count), offsets(count), values(count), float_sums;
    std::vector<int32_t> wide(count);
    std::vector<int> which(count);
    std::vector<MapIndex::Centring> centring(7);
    for (auto& each : centring) each = {real(random), 20 * real(random)};
    for (size_t i = 0; i < count; ++i) {
      products[i] = static_cast<uint16_t>(word(random));
      wide[i] = 5 * word(random) - 60000;
      words[i] = static_cast<uint16_t>(word(random));
      more[i] = static_cast<uint16_t>(word(random));
      bytes[i] = static_cast<uint8_t>(byte(random));
      scales[i] = 0.1F * real(random);
      offsets[i] = 100 * real(random);
      which[i] = byte(random) % 8 - 1;
    }
    evidence_of(products.data(), scales.data(), offsets.data(), count, line, levels, weights.data());
    evidence_of(wide.data(), which.data(), centring.data(), count, line, values.data());
    sums = words;
    add(bytes.data(), count, sums.data());
    float_sums = scales;
    add(words.data(), 0.25F, count, float_sums.data());
    largest_of(words.data(), more.data(), products.data(), count, most.data());
    for (size_t i = 0; i < count; ++i) {
      const float said = levels * line.evidence(products[i], scales[i], offsets[i]);
      EXPECT_NEAR(weights[i], said, 0.5001) << i << " of " << count;
      const auto feature = static_cast<size_t>(std::max(0, which[i]));
      const float expected =
          which[i] < 0 ? 0
                       : line.evidence(static_cast<float>(wide[i]), centring[feature].scale, centring[feature].offset);
      EXPECT_EQ(values[i], expected) << i << " of " << count;
      EXPECT_EQ(sums[i], words[i] + bytes[i]);
      EXPECT_EQ(float_sums[i], scales[i] + 0.25F * words[i]);
      EXPECT_EQ(most[i], std::max({words[i], more[i], products[i]}));
    }
  }
}

TEST(DotProducts, AQuadraticFormIsThatOfTheWholeMatrix) {
  std::srand(3);
  for (const int size : {32, 64, 128}) {
    const Eigen::MatrixXf half = Eigen::MatrixXf::Random(size, size);
    const Eigen::MatrixXf matrix = half + half.transpose();
    const Eigen::VectorXf vector = Eigen::VectorXf::Random(size);
    const double expected = vector.cast<double>().dot(matrix.cast<double>() * vector.cast<double>());
    EXPECT_NEAR(quadratic_form(vector.data(), matrix.data(), static_cast<size_t>(size)), expected, 1e-4 * size);
  }
}

TEST(DotProducts, OfCoarseDescriptorsFitIntoFifteenBits) {
  // The two extremes: all in one component, and evenly spread.
  for (const int used : {1, 3, 128}) {
    std::array<uint8_t, kSiftBytes> descriptor{};
    for (int i = 0; i < used; ++i) {
      descriptor[static_cast<size_t>(i)] = static_cast<uint8_t>(std::min(255.0, kRootSiftLength / std::sqrt(used)));
    }
    std::array<uint8_t, kCoarseBytes> coarse{}, query{};
    coarsen(descriptor.data(), kCoarseLength, coarse.data());
    coarsen(descriptor.data(), kCoarseQueryLength, query.data());
    int product = 0;
    for (size_t k = 0; k < coarse.size(); ++k) {
      EXPECT_LT(query[k], 128);
      product += coarse[k] * query[k];
    }
    EXPECT_LT(product, 1 << 15);
    EXPECT_GT(product, 25000);
  }
}

// 2 x 0.6 + 3 x 0.1 + 600 / 3000 + 0.1 x 1 - 0.0375 x 8 = 1.5, which is what is needed.
Standing just_clear() {
  return {.log_likelihood = 1000,
          .log_likelihood_ratio = 600.1,
          .aligned_share = 0.1,
          .inliers = 30,
          .held = 1,
          .num_keyframes = 8};
}

bool is_refused(const Standing& place) {
  return !doubt(place, {}).empty();
}

TEST(Doubt, IsNoneOfAPlaceWhoseEvidenceIsEnough) {
  EXPECT_EQ(doubt(just_clear(), {}), "");
}

TEST(Doubt, IsOfAPlaceThatLacksAPieceOfTheEvidence) {
  Standing place = just_clear();
  place.log_likelihood_ratio = 599;
  EXPECT_THAT(doubt(place, {}), HasSubstr("ratio 599 of 1000, evidence 1.50, held 1"));
  place = just_clear();
  place.aligned_share = 0.099;
  EXPECT_TRUE(is_refused(place));
  place = just_clear();
  place.held = 0;
  EXPECT_TRUE(is_refused(place));
  place = just_clear();
  place.num_keyframes = 9;
  EXPECT_TRUE(is_refused(place));
}

TEST(Doubt, IsLessOfAPlaceThatHasHeldOverNewGround) {
  Standing place{.log_likelihood = 1000,
                 .log_likelihood_ratio = 205,
                 .aligned_share = 0.1,
                 .inliers = 30,
                 .held = 12,
                 .num_keyframes = 16};
  EXPECT_TRUE(is_refused(place));  // 1.38
  place.held = 14;
  EXPECT_FALSE(is_refused(place));
  // What it looks like itself has to say something, however long it held, and more than a submap is no news.
  place.log_likelihood_ratio = 195;
  place.held = 1000;
  EXPECT_TRUE(is_refused(place));
  place.log_likelihood_ratio = 205;
  place.aligned_share = 0;
  EXPECT_THAT(doubt(place, {}), HasSubstr("evidence 1.48"));
}

TEST(Doubt, IsOfFewInliersAndOfSmallRatios) {
  Standing place = just_clear();
  place.inliers = 7;
  EXPECT_TRUE(is_refused(place));
  place = {.log_likelihood = 150, .log_likelihood_ratio = 149, .aligned_share = 0.9, .inliers = 50};
  EXPECT_TRUE(is_refused(place));
}

TEST(Doubt, AsksForAShareAloneWhereTheAircraftIsExpected) {
  Standing place{.log_likelihood = 1000, .log_likelihood_ratio = 350, .inliers = 8, .num_keyframes = 16};
  EXPECT_TRUE(is_refused(place));
  place.is_expected = true;
  EXPECT_FALSE(is_refused(place));
  place.log_likelihood_ratio = 349;
  EXPECT_TRUE(is_refused(place));
}

class SubmapTest : public testing::Test {
 protected:
  MapFeatures features() const {
    MapFeatures features = ground_.grid_features(12);
    std::vector<cv::Point2f> points;
    for (const Eigen::Vector3f& p : features.positions) {
      points.emplace_back(p.x() / 0.3F - 0.5F, -p.y() / 0.3F - 0.5F);
    }
    features.descriptors = OrientationField(ground_.picture(), {.keypoint_size = 12}).describe(points);
    return features;
  }
  Fix add(SubmapRegistrar& registrar, const Capture& capture, const Heading& heading,
          const std::optional<PositionPrior>& prior = {}, int session = 1) const {
    registrar.describe(capture.keyframe, session, capture.image, heading);
    registrar.search(prior);
    return registrar.solve();
  }
  SyntheticFields ground_{1};
};

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

TEST_F(SubmapTest, AWoodUnderTheFirstFixIsToldFromTheFieldsBeforeIt) {
  MapFeatures map = features();
  for (Eigen::Vector3f& position : map.positions) position.z() = 20;
  const MapIndex index(std::move(map), kMap);
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

TEST_F(SubmapTest, IndexFindsEveryFeatureByItsPlace) {
  MapFeatures all = features();
  // Holes, as water and missing data leave them.
  MapFeatures some;
  for (size_t i = 0; i < all.positions.size(); ++i) {
    if (i % 7 == 3 || i < 200) continue;
    some.positions.push_back(all.positions[i]);
    some.descriptors.push_back(all.descriptors.row(static_cast<int>(i)));
  }
  const MapFeatures given = some;
  const MapIndex index(std::move(some), kMap);
  EXPECT_EQ(index.pitch(), 3.0);
  int found = 0;
  for (int row = 0; row < index.rows(); ++row) {
    for (int column = 0; column < index.columns(); ++column) {
      const int feature = index.feature(row, column);
      if (feature < 0) continue;
      ++found;
      const Eigen::Vector2d en = given.positions[static_cast<size_t>(feature)].head<2>().cast<double>();
      EXPECT_LT((index.place(row, column) - en).norm(), 1e-3);
      EXPECT_LT((index.cell(en) - Eigen::Vector2d(column, row)).norm(), 1e-3);
    }
  }
  EXPECT_EQ(found, index.num_features());
  EXPECT_EQ(index.feature(-1, 0), -1);
  EXPECT_EQ(index.feature(0, index.columns()), -1);
}

TEST_F(SubmapTest, IndexRefusesWhatIsNoGrid) {
  EXPECT_THROW(MapIndex({}, kMap), std::invalid_argument);
  EXPECT_THROW(MapIndex(features(), {0.3, 12, 0}), std::invalid_argument);
  MapFeatures far = features();
  far.positions.front().x() = 1e8F;
  EXPECT_THROW(MapIndex(std::move(far), kMap), std::invalid_argument);
  MapFeatures nan = features();
  nan.positions.front().x() = NAN;
  EXPECT_THROW(MapIndex(std::move(nan), kMap), std::invalid_argument);
  MapFeatures floats = features();
  floats.descriptors.convertTo(floats.descriptors, CV_32F);
  EXPECT_THROW(MapIndex(std::move(floats), kMap), std::invalid_argument);
}

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
  registrar.set_map(features(), kMap);
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
    registrar.set_map(features(), kMap);
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
    registrar.set_map(features(), kMap);
    Fix fix;
    Capture capture;
    for (int i = 0; i < 11; ++i) {
      capture = scaled(ground_.capture({40.0 + 10 * i, -80, 60}, 1.0, 0.03, -0.04), factor);
      capture.keyframe.scale_stddev = 0.003;  // as it says of itself
      fix = add(registrar, capture, capture.heading, PositionPrior{capture.p_G_B.head<2>(), 2});
      if (i == 0 || !fix.valid) continue;
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

TEST_F(SubmapTest, APointTriangulatedFarBelowTheGroundChangesNothing) {
  SubmapRegistrar registrar({}, test_camera()), other({}, test_camera());
  registrar.set_map(features(), kMap);
  other.set_map(features(), kMap);
  const Capture capture = ground_.capture({95, -80, 60}, 1.0, 0.03, -0.04);
  Capture far = capture;
  far.keyframe.points.push_back(far.keyframe.points.front());
  far.keyframe.points.back().p_W += 200 * (far.keyframe.points.back().p_W - far.keyframe.p_W_B);
  const PositionPrior prior{{97, -77}, 2};
  EXPECT_EQ(add(registrar, far, far.heading, prior).p_G_B, add(other, capture, capture.heading, prior).p_G_B);
}

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

TEST_F(SubmapTest, ACompassesBiasIsLeftBehindFixByFix) {
  SubmapRegistrar registrar({}, test_camera());
  registrar.set_map(features(), kMap);
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
    const auto with_ratio = [&](double ratio, double error) {
      SubmapOptions options;
      options.min_likelihood_ratio = ratio;
      SubmapRegistrar registrar(options, test_camera());
      registrar.set_map(features(), kMap);
      return add(registrar, capture, {1.0 + error, 0.05});
    };
    const double right = with_ratio(0, 0).log_likelihood_ratio;
    const double believed = with_ratio(0, heading_error).log_likelihood_ratio;
    ASSERT_LT(believed, 0.8 * right);
    const Fix fix = with_ratio(0.5 * (right + believed), heading_error);
    ASSERT_TRUE(fix.valid) << fix.reason;
    EXPECT_GT(fix.log_likelihood_ratio, believed);
    EXPECT_NEAR(fix.heading_correction, -heading_error, 2.5 * fix.heading_correction_stddev);
    EXPECT_LT((fix.p_G_B - capture.p_G_B).head<2>().norm(), 0.5);
  }
}

TEST_F(SubmapTest, FindsTheHeadingWhereNoneIsKnown) {
  SubmapOptions options;
  options.search_heading = true;
  SubmapRegistrar registrar(options, test_camera());
  registrar.set_map(features(), kMap);
  const Capture capture = ground_.capture({95, -80, 60}, 1.0, 0.03, -0.04);
  const Fix fix = add(registrar, capture, {1.0 + 2.5, 0.05});
  ASSERT_TRUE(fix.valid) << fix.reason;
  EXPECT_LT((fix.p_G_B - capture.p_G_B).norm(), 1.0);
  EXPECT_NEAR(fix.heading_correction, -2.5, 0.03);
}

TEST_F(SubmapTest, TheMoreKeyframesTheSurer) {
  SubmapRegistrar registrar({}, test_camera());
  registrar.set_map(features(), kMap);
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
    registrar.set_map(features(), kMap);
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

TEST_F(SubmapTest, KeepsOfTheOlderKeyframesThoseThatSawNewGround) {
  SubmapRegistrar registrar({}, test_camera());
  registrar.set_map(features(), kMap);
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
    registrar.set_map(features(), kMap);
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
  registrar.set_map(features(), kMap);
  const Capture capture = ground_.capture({95, -80, 60}, 1.0, 0.03, -0.04);
  const Fix near = add(registrar, capture, capture.heading, PositionPrior{{97, -77}, 2});
  ASSERT_TRUE(near.valid) << near.reason;
  EXPECT_LT((near.p_G_B - capture.p_G_B).head<2>().norm(), 0.5);
  EXPECT_EQ(near.search_radius, 15);
  // The expectation goes astray. Never a fix there, and then one where the aircraft is.
  SubmapRegistrar lost({}, test_camera());
  lost.set_map(features(), kMap);
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

TEST_F(SubmapTest, WhatLiesInTheWidenedPartOfASearchIsNotExpected) {
  SubmapOptions strict;  // accepts nothing but where the aircraft is expected
  strict.min_evidence = 10;
  const Capture capture = ground_.capture({95, -80, 60}, 1.0, 0.03, -0.04);
  SubmapRegistrar registrar(strict, test_camera());
  registrar.set_map(features(), kMap);
  EXPECT_TRUE(add(registrar, capture, capture.heading, PositionPrior{{105, -88}, 2}).valid);
  SubmapRegistrar lost(strict, test_camera());
  lost.set_map(features(), kMap);
  const Fix here = add(lost, capture, capture.heading, PositionPrior{{95, -61}, 2});  // 19 m off, 15 m are searched
  EXPECT_FALSE(here.valid);
  const Fix wider = add(lost, capture, capture.heading, PositionPrior{{95, -61}, 2});
  EXPECT_EQ(wider.search_radius, 22.5);
  EXPECT_LT(
      (wider.translation +
       (rotation_G_W(capture.keyframe.q_W_B, capture.heading.value + wider.heading_correction) * capture.keyframe.p_W_B)
           .head<2>() -
       capture.p_G_B.head<2>())
          .norm(),
      1.0)
      << "found, ";
  EXPECT_FALSE(wider.valid) << "but not believed";
}

TEST_F(SubmapTest, IsNotSureOnAnotherGround) {
  SubmapRegistrar registrar({}, test_camera());
  registrar.set_map(features(), kMap);
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
  registrar.set_map(features(), kMap);
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
