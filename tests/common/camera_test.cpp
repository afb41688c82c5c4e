#include <cmath>

#include <gtest/gtest.h>
#include <opencv2/calib3d.hpp>

#include "common/camera/camera_model.h"
#include "common/config/config.h"

namespace orthonav {
namespace {

CameraParameters euroc_like(LensModel model) {
  CameraParameters p;
  p.width = 752;
  p.height = 480;
  p.fx = 458.6;
  p.fy = 457.3;
  p.cx = 367.2;
  p.cy = 248.4;
  p.model = model;
  p.distortion = model == LensModel::kRadtan ? std::array<double, 4>{-0.283, 0.074, 0.0002, 0.00002}
                                             : std::array<double, 4>{-0.01, 0.02, -0.01, 0.002};
  return p;
}

class CameraLens : public testing::TestWithParam<LensModel> {};
INSTANTIATE_TEST_SUITE_P(Lenses, CameraLens, testing::Values(LensModel::kRadtan, LensModel::kEquidistant));

TEST_P(CameraLens, UnprojectInvertsProjectOverTheWholeImage) {
  const CameraModel camera(euroc_like(GetParam()));
  for (double v = 0; v < camera.height(); v += 20) {
    for (double u = 0; u < camera.width(); u += 20) {
      const auto ray = camera.unproject({u, v});
      ASSERT_TRUE(ray.has_value());
      EXPECT_DOUBLE_EQ(ray->z(), 1.0);
      const auto pixel = camera.project(*ray * 37.0);
      ASSERT_TRUE(pixel.has_value());
      EXPECT_LT((*pixel - Eigen::Vector2d(u, v)).norm(), 1e-6);
    }
  }
}

TEST_P(CameraLens, ProjectsAsOpenCvDoes) {
  const CameraParameters p = euroc_like(GetParam());
  const CameraModel camera(p);
  const cv::Matx33d K(p.fx, 0, p.cx, 0, p.fy, p.cy, 0, 0, 1);
  const std::vector<double> d(p.distortion.begin(), p.distortion.end());
  const std::vector<cv::Point3d> points{{0.4, -0.3, 1.2}, {-0.7, 0.2, 1.5}, {0, 0, 2}};
  std::vector<cv::Point2d> expected;
  if (p.model == LensModel::kRadtan) {
    cv::projectPoints(points, cv::Vec3d(), cv::Vec3d(), K, d, expected);
  } else {
    cv::fisheye::projectPoints(points, expected, cv::Vec3d(), cv::Vec3d(), K, d);
  }
  for (size_t i = 0; i < points.size(); ++i) {
    const auto pixel = camera.project({points[i].x, points[i].y, points[i].z});
    ASSERT_TRUE(pixel.has_value());
    EXPECT_NEAR(pixel->x(), expected[i].x, 1e-9);
    EXPECT_NEAR(pixel->y(), expected[i].y, 1e-9);
  }
}

TEST(Camera, PointsBehindOrBeyondTheLensModelDoNotProject) {
  const CameraModel camera(euroc_like(LensModel::kRadtan));
  EXPECT_FALSE(camera.project({0, 0, -1}).has_value());
  EXPECT_FALSE(camera.project({0, 0, 0}).has_value());
  // Past the radius where the polynomial turns back, the point would fold into the image.
  CameraParameters turning = euroc_like(LensModel::kRadtan);
  turning.distortion = {-0.283, 0, 0, 0};
  EXPECT_TRUE(CameraModel(turning).project({1.0, 0, 1}).has_value());
  EXPECT_FALSE(CameraModel(turning).project({1.2, 0, 1}).has_value());
  EXPECT_FALSE(CameraModel(turning).project({3.0, 0, 1}).has_value());
}

TEST(Camera, WrongCalibrationNamesFileLineAndMember) {
  auto node = ConfigNode::parse("width: 640\nheight: 480\nfx: -5\nfy: 400\ncx: 320\ncy: 240\n", "cam.yaml");
  try {
    CameraModel::from_config(node);
    FAIL() << "a negative focal length was accepted";
  } catch (const ConfigError& error) {
    EXPECT_NE(std::string(error.what()).find("'fx'"), std::string::npos) << error.what();
    EXPECT_NE(std::string(error.what()).find("cam.yaml"), std::string::npos) << error.what();
  }
}

TEST(Camera, ExtrinsicsMustBeARotation) {
  auto node = ConfigNode::parse("p_B_C: [0, 0, 0]\nR_B_C: [1, 0, 0, 0, 1, 0, 0, 0.3, 1]\n", "x.yaml");
  EXPECT_THROW(Extrinsics::from_config(node), ConfigError);
}

}  // namespace
}  // namespace orthonav
