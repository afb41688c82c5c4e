#include "services/registration/paper/registrar.h"

#include <Eigen/Eigenvalues>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "tests/registration/synthetic_flight.h"

namespace orthonav::registration {
namespace {

using testing::HasSubstr;

const MapGeometry kGrid{SyntheticGround::kSigma, 8, 10};
const MapGeometry kDetected{SyntheticGround::kSigma, 0, 0};

Fix register_to(Registrar& registrar, const Capture& capture) {
  const Query query = registrar.describe(capture.keyframe, capture.image, capture.heading);
  return registrar.solve(capture.keyframe, query, registrar.match(query), capture.heading);
}

RegistrarOptions options_of(MethodName method) {
  RegistrarOptions options;
  options.method = method;
  return options;
}

TEST(Matcher, FindsAlmostEveryDescriptorOfItsOwnMap) {
  const MapFeatures features = SyntheticGround(1).grid_features(8);
  FlannMatcher matcher(features.descriptors, {});
  const auto matches = matcher.match(features.descriptors);
  int found = 0;
  for (const DescriptorMatch& match : matches) found += match.map == match.query && match.distance == 0 ? 1 : 0;
  EXPECT_GT(found, 0.95 * features.descriptors.rows);
}

TEST(Matcher, RepeatsItself) {
  const MapFeatures features = SyntheticGround(1).grid_features(8);
  const MapFeatures queries = SyntheticGround(2, 200).grid_features(8);
  const auto indices = [&](int disturbance) {
    cv::setRNGSeed(disturbance);
    FlannMatcher matcher(features.descriptors, {});
    cv::setRNGSeed(disturbance + 1);
    std::vector<int> result;
    for (const DescriptorMatch& match : matcher.match(queries.descriptors)) result.push_back(match.map);
    return result;
  };
  EXPECT_EQ(indices(5), indices(99));
}

TEST(Matcher, WantsDescriptors) {
  EXPECT_THROW(FlannMatcher(cv::Mat(), {}), std::invalid_argument);
  EXPECT_THROW(FlannMatcher(cv::Mat::zeros(5, 128, CV_32F), {}), std::invalid_argument);
}

class EveryMethod : public testing::TestWithParam<MethodName> {
 protected:
  EveryMethod() : registrar_(options_of(GetParam()), test_camera()) {
    const bool detected = GetParam() == MethodName::kM2;
    registrar_.set_map(detected ? ground_.detected_features() : ground_.grid_features(8), detected ? kDetected : kGrid);
  }
  SyntheticGround ground_{1};
  Registrar registrar_;
};

TEST_P(EveryMethod, FindsItselfOnTheMapFromAnUnknownStart) {
  for (const double heading : {0.3, 2.0, 4.5}) {
    const Capture capture = ground_.capture({95, -80, 60}, heading, 0.03, -0.04);
    const Fix fix = register_to(registrar_, capture);
    ASSERT_TRUE(fix.valid) << fix.reason;
    EXPECT_GE(fix.num_inliers, 15);
    EXPECT_LT(fix.num_second_inliers, fix.num_inliers / 2);
    EXPECT_EQ(fix.pairs.size(), static_cast<size_t>(fix.num_inliers));
    const Eigen::Vector3d error = fix.p_G_B - capture.p_G_B;
    // The image's translation takes the tilted picture of the ground for a map: its middle stays in place.
    EXPECT_LT(error.head<2>().norm(), GetParam() == MethodName::kPaper ? 0.6 : 1.5) << heading;
    EXPECT_LT(std::abs(error.z()), 1.0);
    EXPECT_LT(fix.q_G_B.angularDistance(capture.q_G_B), 0.02);
    const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> eigen(fix.covariance);
    EXPECT_GT(eigen.eigenvalues().minCoeff(), 0.01);
    EXPECT_LT(eigen.eigenvalues().maxCoeff(), 25);
  }
}

TEST_P(EveryMethod, IsNotSureOnAnotherGround) {
  const Capture elsewhere = SyntheticGround(77).capture({95, -80, 60}, 1.0, 0.03, -0.04);
  const Fix fix = register_to(registrar_, elsewhere);
  EXPECT_GT(fix.num_candidates, 20);
  // Where the truth is on the map, second places have less than half of the first's inliers. The detector gives m2
  // hundreds of votes, of which 15 agree by chance: that method has no other defence.
  EXPECT_GT(2 * fix.num_second_inliers, fix.num_inliers);
  if (GetParam() == MethodName::kM2) return;
  EXPECT_FALSE(fix.valid);
  EXPECT_THAT(fix.reason, HasSubstr("inliers"));
}

TEST_P(EveryMethod, PassesOnWhyAKeyframeWasRefused) {
  Capture capture = ground_.capture({95, -80, 60}, 1.0, 0.03, -0.04);
  capture.keyframe.height_above_ground = -1;
  const Fix fix = register_to(registrar_, capture);
  EXPECT_FALSE(fix.valid);
  EXPECT_THAT(fix.reason, HasSubstr("height"));
}

INSTANTIATE_TEST_SUITE_P(Registration, EveryMethod,
                         testing::Values(MethodName::kPaper, MethodName::kM1, MethodName::kM2),
                         [](const auto& instance) { return std::string(name_of(instance.param)); });

TEST(Paper, TakesTheErrorsOfCompassAndScaleIntoItsCovariance) {
  const SyntheticGround ground(1);
  Registrar registrar(options_of(MethodName::kPaper), test_camera());
  registrar.set_map(ground.grid_features(8), kGrid);
  Capture capture = ground.capture({95, -80, 60}, 1.0, 0.1, -0.1, 1.02);
  capture.heading.value += 0.04;
  const Fix fix = register_to(registrar, capture);
  ASSERT_TRUE(fix.valid) << fix.reason;
  const Eigen::Vector3d error = fix.p_G_B - capture.p_G_B;
  EXPECT_LT(error.norm(), 3);
  EXPECT_LT(error.dot(fix.covariance.ldlt().solve(error)), 11.3);  // 99 % of chi-square with 3 degrees of freedom
  // The height error of a wrong scale is the larger part here: 2 % of 60 m.
  EXPECT_GT(fix.covariance(2, 2), 1.2 * 1.2);
}

TEST(Paper, RefusesAPoseWhoseVerticalIsNotTheOdometrys) {
  const SyntheticGround ground(1);
  RegistrarOptions options = options_of(MethodName::kPaper);
  options.max_tilt_difference = 0.05;
  Registrar registrar(options, test_camera());
  registrar.set_map(ground.grid_features(8), kGrid);
  Capture capture = ground.capture({95, -80, 60}, 1.0, 0.03, -0.04);
  capture.keyframe.q_W_B = capture.keyframe.q_W_B * so3_exp({0.12, 0, 0});
  const Fix fix = register_to(registrar, capture);
  EXPECT_FALSE(fix.valid);
  EXPECT_THAT(fix.reason, HasSubstr("vertical"));
}

TEST(Registrar, RefusesAMapOfTheOtherKindAndWorksOnlyWithOne) {
  const SyntheticGround ground(1, 200);
  Registrar m2(options_of(MethodName::kM2), test_camera());
  EXPECT_THROW(m2.set_map(ground.grid_features(8), kGrid), std::invalid_argument);
  Registrar paper(options_of(MethodName::kPaper), test_camera());
  EXPECT_THROW(paper.set_map(ground.detected_features(), kDetected), std::invalid_argument);
  EXPECT_THROW(paper.set_map({}, kGrid), std::invalid_argument);
  EXPECT_FALSE(paper.has_map());
  const Capture capture = ground.capture({30, -30, 40}, 1.0, 0, 0);
  EXPECT_THROW((void)paper.describe(capture.keyframe, capture.image, capture.heading), std::logic_error);
}

TEST(RegistrarOptions, ReadsTheShippedDefaultsAndNamesErrors) {
  ConfigNode shipped = ConfigNode::load(std::filesystem::path(ORTHONAV_SOURCE) / "config/default/registration.yaml");
  const RegistrarOptions read = RegistrarOptions::from_config(shipped);
  const RegistrarOptions built_in;
  EXPECT_EQ(read.min_inliers, built_in.min_inliers);
  EXPECT_EQ(read.voting.inlier_radius, built_in.voting.inlier_radius);
  EXPECT_EQ(read.matcher.trees, built_in.matcher.trees);
  EXPECT_EQ(read.matcher.checks, built_in.matcher.checks);
  EXPECT_NEAR(read.max_tilt_difference, built_in.max_tilt_difference, 1e-12);
  EXPECT_NEAR(read.query.max_tilt, built_in.query.max_tilt, 1e-12);
  EXPECT_EQ(read.errors.matches_per_observation, built_in.errors.matches_per_observation);
  for (const char* text : {"method: ours", "voting: {min_inliers: 2}", "query: {min_point: 3}"}) {
    ConfigNode node = ConfigNode::parse(text, "registration.yaml");
    EXPECT_THROW((void)RegistrarOptions::from_config(node), ConfigError) << text;
  }
}

}  // namespace
}  // namespace orthonav::registration
