#include "services/registration/paper/query.h"

#include <limits>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "tests/registration/synthetic_flight.h"

namespace orthonav::registration {
namespace {

using testing::HasSubstr;

const MapGeometry kMap{SyntheticGround::kSigma, 8, 10};

TEST(RotationToTheMap, GivesTheBodyItsTrueHeading) {
  for (const double heading : {0.0, 1.0, 3.0, 5.5}) {
    const Eigen::Quaterniond q_W_B = so3_exp({0, 0, 0.4}) * so3_exp({0.1, -0.08, 0});
    const Eigen::Quaterniond q_G_B(rotation_G_W(q_W_B, heading) * q_W_B.toRotationMatrix());
    EXPECT_NEAR(wrap_angle(heading_of(q_G_B) - heading), 0, 1e-12);
    // Only the yaw changes: (7) is a rotation about z.
    EXPECT_NEAR((rotation_G_W(q_W_B, heading) * Eigen::Vector3d::UnitZ() - Eigen::Vector3d::UnitZ()).norm(), 0, 1e-12);
  }
}

TEST(ViewSimilarity, PutsALevelCamerasGroundOnMapPixels) {
  const SyntheticGround ground(1);
  const Capture capture = ground.capture({90, -90, 60}, 2.2, 0, 0);
  const CameraModel camera = test_camera();
  const Eigen::Matrix3d R_G_C = capture.q_G_B.toRotationMatrix() * capture.keyframe.extrinsics.R_B_C;
  const ImageSimilarity s = view_similarity(camera, R_G_C, 60, 0.3, 1.0);
  for (const Eigen::Vector2d& a : {Eigen::Vector2d(0.2, 0.1), Eigen::Vector2d(-0.3, 0.2)}) {
    const Eigen::Vector3d east_north = R_G_C * (60 * a.homogeneous());
    const Eigen::Vector2d pixel = s.apply(a) - s.origin;
    EXPECT_NEAR(pixel.x(), east_north.x() / 0.3, 1e-9);
    EXPECT_NEAR(pixel.y(), -east_north.y() / 0.3, 1e-9);
    EXPECT_NEAR((s.invert(s.apply(a)) - a).norm(), 0, 1e-12);
  }
  // The whole image is inside.
  for (const Eigen::Vector2d& corner : {Eigen::Vector2d(0, 0), Eigen::Vector2d(319, 239)}) {
    const Eigen::Vector2d pixel = s.apply(camera.unproject(corner)->head<2>());
    EXPECT_GE(pixel.minCoeff(), -1e-6);
    EXPECT_LT(pixel.x(), s.size.width);
    EXPECT_LT(pixel.y(), s.size.height);
  }
}

TEST(ViewSimilarity, OfATiltedCameraIsTheNearestAtTheCentre) {
  const Capture capture = SyntheticGround(1).capture({90, -90, 60}, 0.6, 0.15, -0.1);
  const Eigen::Matrix3d R_G_C = capture.q_G_B.toRotationMatrix() * capture.keyframe.extrinsics.R_B_C;
  const ImageSimilarity s = view_similarity(test_camera(), R_G_C, 60, 0.3, 1.0);
  // Small steps on the ground in the image's two directions: their mean turn is that of the similarity.
  const auto ground = [&](double x, double y) -> Eigen::Vector2d {
    const Eigen::Vector3d ray = R_G_C * Eigen::Vector3d(x, y, 1);
    const Eigen::Vector2d en = ray.head<2>() * 60 / -ray.z();
    return {en.x(), -en.y()};
  };
  const Eigen::Vector2d right = ground(1e-5, 0) - ground(-1e-5, 0);
  const Eigen::Vector2d down = ground(0, 1e-5) - ground(0, -1e-5);
  EXPECT_NEAR(s.angle, std::atan2(right.y() - down.x(), right.x() + down.y()), 1e-6);
}

TEST(ViewSimilarity, RefusesWhatNoSimilarityCanFit) {
  const Eigen::Matrix3d level = so3_exp({M_PI, 0, 0}).toRotationMatrix();
  EXPECT_THROW((void)view_similarity(test_camera(), so3_exp({M_PI - 1.2, 0, 0}).toRotationMatrix(), 60, 0.3, 0.8),
               std::invalid_argument);
  EXPECT_THROW((void)view_similarity(test_camera(), Eigen::Matrix3d::Identity(), 60, 0.3, 0.8), std::invalid_argument);
  EXPECT_THROW((void)view_similarity(test_camera(), level, 1e6, 0.3, 0.8), std::invalid_argument);
  EXPECT_THROW((void)view_similarity(test_camera(), level, 0.5, 0.3, 0.8), std::invalid_argument);
}

TEST(Query, UsesPointsWithSmallReprojectionErrorOnly) {
  const SyntheticGround ground(1);
  Capture capture = ground.capture({90, -90, 60}, 1.0, 0.05, 0.02);
  const size_t all = capture.keyframe.points.size();
  for (size_t i = 0; i < 5; ++i) capture.keyframe.points[i].reprojection_error = 8.01;
  const Query query =
      make_query(capture.keyframe, capture.image, test_camera(), capture.heading.value, kMap, QueryOptions());
  EXPECT_EQ(query.refused, "");
  EXPECT_EQ(query.points.size(), all - 5);
  EXPECT_EQ(query.points.front().index, 5);
  EXPECT_EQ(query.descriptors.rows, static_cast<int>(all) - 5);
}

TEST(Query, LeavesTheImageAsItWas) {
  const Capture capture = SyntheticGround(1).capture({95, -80, 40}, 1.0, 0.03, -0.04);  // finer than the map: smoothed
  const cv::Mat before = capture.image.clone();
  make_query(capture.keyframe, capture.image, test_camera(), 1.0, kMap, {});
  EXPECT_EQ(cv::norm(before, capture.image, cv::NORM_INF), 0);
}

class BadInput : public testing::Test {
 protected:
  std::string refused() {
    return make_query(capture_.keyframe, capture_.image, test_camera(), heading_, kMap, QueryOptions()).refused;
  }
  Capture capture_ = SyntheticGround(1).capture({90, -90, 60}, 1.0, 0.05, 0.02);
  double heading_ = 1.0;
  const double nan_ = std::numeric_limits<double>::quiet_NaN();
};

TEST_F(BadInput, IsFineToBeginWith) {
  EXPECT_EQ(refused(), "");
}

TEST_F(BadInput, TooFewPoints) {
  capture_.keyframe.points.resize(20);
  EXPECT_THAT(refused(), HasSubstr("20 usable points"));
  capture_.keyframe.points.clear();
  EXPECT_THAT(refused(), HasSubstr("0 usable points"));
}

TEST_F(BadInput, PointsThatAreNotFiniteAreLeftOut) {
  for (TrackedPoint& point : capture_.keyframe.points) point.p_W.y() = nan_;
  EXPECT_THAT(refused(), HasSubstr("0 usable points"));
}

TEST_F(BadInput, Heights) {
  for (const double height : {0.0, -5.0, nan_, std::numeric_limits<double>::infinity()}) {
    capture_.keyframe.height_above_ground = height;
    EXPECT_THAT(refused(), HasSubstr("height above ground")) << height;
  }
  capture_.keyframe.height_above_ground = 1e7;
  EXPECT_THAT(refused(), HasSubstr("map pixels"));
}

TEST_F(BadInput, HeadingThatIsNotANumber) {
  heading_ = nan_;
  EXPECT_THAT(refused(), HasSubstr("heading"));
}

TEST_F(BadInput, Poses) {
  capture_.keyframe.q_W_B.x() = nan_;
  EXPECT_THAT(refused(), HasSubstr("pose"));
  capture_.keyframe.q_W_B = Eigen::Quaterniond(0, 0, 0, 0);
  EXPECT_THAT(refused(), HasSubstr("pose"));
}

TEST_F(BadInput, Images) {
  capture_.image = cv::Mat();
  EXPECT_THAT(refused(), HasSubstr("image"));
  capture_.image = cv::Mat::zeros(100, 100, CV_8U);
  EXPECT_THAT(refused(), HasSubstr("100 x 100"));
  capture_.image = cv::Mat::zeros(240, 320, CV_8UC3);
  EXPECT_THAT(refused(), HasSubstr("grey"));
  capture_.image = cv::Mat::zeros(240, 320, CV_8U);  // a lens cap: no gradient anywhere
  EXPECT_THAT(refused(), HasSubstr("0 usable points"));
}

}  // namespace
}  // namespace orthonav::registration
