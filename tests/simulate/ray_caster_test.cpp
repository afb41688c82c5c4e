#include "tools/simulate/ray_caster.h"

#include <cmath>

#include <gtest/gtest.h>

#include "common/math/so3.h"
#include "tests/simulate/flight_fixtures.h"
#include "tools/simulate/camera_effects.h"

namespace orthonav::simulate {
namespace {

CameraModel rural_camera() {
  return Scenario::load(config_folder("rural")).camera;
}

// Looking down, the top of the picture to the north, tilted by a rotation vector in C.
CameraPose looking_down(const Eigen::Vector3d& p_G_C, const Eigen::Vector3d& tilt = Eigen::Vector3d::Zero()) {
  Eigen::Matrix3d R_down;
  R_down << 1, 0, 0, 0, -1, 0, 0, 0, -1;
  return {p_G_C, R_down * so3_exp(tilt).toRotationMatrix()};
}

// 200 x 200 m at 0.1 m around the origin of G, of constant luminance.
Surface plain(const std::function<double(double east, double north)>& height, uint8_t luminance = 50) {
  Surface surface{-100, 100, 0.1, cv::Mat(2000, 2000, CV_32F), cv::Mat(2000, 2000, CV_8U, cv::Scalar(luminance))};
  for (int v = 0; v < 2000; ++v) {
    for (int u = 0; u < 2000; ++u) {
      surface.height.at<float>(v, u) = static_cast<float>(height(-100 + (u + 0.5) * 0.1, 100 - (v + 0.5) * 0.1));
    }
  }
  return surface;
}

// A bright spot of 0.3 m radius.
void paint_dot(Surface& surface, const Eigen::Vector2d& p_en) {
  const double u = (p_en.x() - surface.east_min) / surface.resolution - 0.5;
  const double v = (surface.north_max - p_en.y()) / surface.resolution - 0.5;
  for (int y = static_cast<int>(v) - 12; y <= static_cast<int>(v) + 13; ++y) {
    for (int x = static_cast<int>(u) - 12; x <= static_cast<int>(u) + 13; ++x) {
      const double square = (x - u) * (x - u) + (y - v) * (y - v);
      surface.luminance.at<uint8_t>(y, x) = static_cast<uint8_t>(50.5 + 200 * std::exp(-0.5 * square / 9.0));
    }
  }
}

// Centroid of what is brighter than the plain around a pixel; NaN without such light.
Eigen::Vector2d find_dot(const cv::Mat& image, const Eigen::Vector2d& near) {
  Eigen::Vector2d sum = Eigen::Vector2d::Zero();
  double weight = 0;
  for (int y = static_cast<int>(near.y()) - 10; y <= static_cast<int>(near.y()) + 11; ++y) {
    for (int x = static_cast<int>(near.x()) - 10; x <= static_cast<int>(near.x()) + 11; ++x) {
      const double light = std::max(0.0, image.at<float>(y, x) - 52.0);
      sum += light * Eigen::Vector2d(x, y);
      weight += light;
    }
  }
  return sum / weight;
}

struct Ground {
  const char* name;
  double (*height)(double east, double north);
};

class Dots : public testing::TestWithParam<Ground> {};

TEST_P(Dots, AreSeenWhereTheyProject) {
  Surface surface = plain(GetParam().height);
  std::vector<Eigen::Vector3d> dots;
  for (const double north : range(-24, 25, 8)) {
    for (const double east : range(-36, 37, 8)) {
      paint_dot(surface, {east + 0.033, north - 0.017});
      dots.emplace_back(east + 0.033, north - 0.017, GetParam().height(east + 0.033, north - 0.017));
    }
  }
  const HeightField field(surface);
  const CameraModel camera = rural_camera();
  const RayCaster caster(field, camera);
  const CameraPose pose = looking_down({1.3, -2.1, 110}, {0.08, -0.05, 0.6});
  const View view = caster.render(pose);
  int seen = 0;
  for (const Eigen::Vector3d& dot : dots) {
    const auto pixel = camera.project(pose.R_G_C.transpose() * (dot - pose.p_G_C));
    if (!pixel || !camera.contains(*pixel, 15)) continue;
    ++seen;
    EXPECT_LT((find_dot(view.luminance, *pixel) - *pixel).norm(), 0.1) << "at " << dot.transpose();
  }
  EXPECT_GT(seen, 30);
  EXPECT_EQ(view.outside, 0);
}

INSTANTIATE_TEST_SUITE_P(
    , Dots,
    testing::Values(Ground{"flat", [](double, double) { return 0.0; }},
                    Ground{"high", [](double, double) { return 37.5; }},
                    Ground{"slope", [](double e, double n) { return 0.3 * e - 0.2 * n; }},
                    Ground{"hills", [](double e, double n) { return 6 * std::sin(e / 20) * std::cos(n / 15); }}),
    [](const auto& parameter) { return parameter.param.name; });

TEST(RayCaster, DepthsAreThoseOfThePlane) {
  const auto height = [](double east, double north) { return 3 + 0.1 * east + 0.25 * north; };
  const Surface surface = plain(height);
  const HeightField field(surface);
  const RayCaster caster(field, rural_camera());
  const CameraPose pose = looking_down({5, 7, 120}, {-0.1, 0.07, 2.0});
  const View view = caster.render(pose);
  for (int j = 0; j < view.node_depth.rows; ++j) {
    for (int i = 0; i < view.node_depth.cols; ++i) {
      const Eigen::Vector3d d = pose.R_G_C * caster.ray(i * View::kNodeStep, j * View::kNodeStep);
      // p.z + s d.z = height(p + s d)
      const double s = (3 + 0.1 * 5 + 0.25 * 7 - 120) / (d.z() - 0.1 * d.x() - 0.25 * d.y());
      EXPECT_NEAR(view.node_depth.at<float>(j, i), -s * d.z(), 1e-3);
    }
  }
}

TEST(RayCaster, BuildingsHideTheGroundBehindThem) {
  // A wall of 12 m from the south edge of the view to the north, 20 m east of the camera.
  const auto wall = [](double east, double) { return east > 20 && east < 24 ? 12.0 : 0.0; };
  Surface with = plain(wall), without = plain([](double, double) { return 0.0; });
  const Eigen::Vector2d behind(24.8, 0), before(19.0, 0);
  for (Surface* surface : {&with, &without}) {
    paint_dot(*surface, behind);
    paint_dot(*surface, before);
  }
  const CameraModel camera = rural_camera();
  const CameraPose pose = looking_down({0, 0, 110});
  const auto brightness = [&](const Surface& surface, const Eigen::Vector2d& p_en) {
    const HeightField field(surface);
    const View view = RayCaster(field, camera).render(pose);
    const Eigen::Vector3d dot(p_en.x(), p_en.y(), 0);
    const Eigen::Vector2d pixel = *camera.project(pose.R_G_C.transpose() * (dot - pose.p_G_C));
    return view.luminance.at<float>(static_cast<int>(std::lround(pixel.y())), static_cast<int>(std::lround(pixel.x())));
  };
  EXPECT_GT(brightness(without, behind), 150);
  EXPECT_GT(brightness(without, before), 150);
  EXPECT_LT(brightness(with, behind), 60);
  EXPECT_GT(brightness(with, before), 150);
}

TEST(RayCaster, FineTextureSeenFromAfarIsGreyNotAliased) {
  Surface surface = plain([](double, double) { return 0.0; });
  for (int v = 0; v < surface.luminance.rows; ++v) {
    for (int u = 0; u < surface.luminance.cols; ++u) {
      surface.luminance.at<uint8_t>(v, u) = ((u / 2 + v / 2) % 2) != 0 ? 200 : 40;
    }
  }
  const HeightField field(surface);
  cv::Scalar mean, deviation;
  cv::meanStdDev(
      RayCaster(field, rural_camera()).render(looking_down({0, 0, 600})).luminance(cv::Rect(270, 190, 100, 100)), mean,
      deviation);
  EXPECT_NEAR(mean[0], 120, 2);
  EXPECT_LT(deviation[0], 4);
}

TEST(RayCaster, CountsPixelsThatLookBeyondTheWorld) {
  const Surface surface = plain([](double, double) { return 0.0; });
  const HeightField field(surface);
  const RayCaster caster(field, rural_camera());
  EXPECT_NEAR(caster.render(looking_down({100, 0, 110})).outside, 0.5, 0.02);
  // Tilted to the horizon, part of the picture is sky.
  const View view = caster.render(looking_down({0, 0, 110}, {1.4, 0, 0}));
  EXPECT_GT(view.outside, 0.5);
  EXPECT_TRUE(std::isnan(view.node_depth.at<float>(0, 0)) || std::isnan(view.node_depth.at<float>(29, 0)));
}

TEST(RayCaster, ARollingShutterSeesEachRowFromWhereTheCameraThenIs) {
  Surface surface = plain([](double east, double north) { return 3.0 * std::sin(0.1 * east) + 0.05 * north; });
  cv::RNG rng(1);
  rng.fill(surface.luminance, cv::RNG::UNIFORM, 0, 255);
  const HeightField field(surface);
  const RayCaster caster(field, rural_camera());
  // 20 m/s, 60 degrees/s of yaw and roll, 30 ms.
  std::vector<CameraPose> rows;
  for (int v = 0; v < 480; ++v) {
    const double t = 0.030 * (v / 479.0 - 0.5);
    rows.push_back(looking_down({20 * t, 5 * t, 110 + 3 * t}, {1.05 * t, 0, 1.05 * t}));
  }
  const View rolling = caster.render(rows);
  for (const int v : {0, 7, 16, 239, 300, 479}) {
    const View at_once = caster.render(rows[static_cast<size_t>(v)]);
    EXPECT_LT(cv::norm(rolling.luminance.row(v), at_once.luminance.row(v), cv::NORM_INF), 1.5) << v;
    if (v != 239) {
      EXPECT_GT(cv::norm(rolling.luminance.row(v), caster.render(rows[239]).luminance.row(v), cv::NORM_INF), 20) << v;
    }
  }
  rows.pop_back();
  EXPECT_THROW(caster.render(rows), std::invalid_argument);
}

TEST(HeightField, RefusesSurfacesThatItCannotShow) {
  Surface surface = plain([](double, double) { return 0.0; });
  surface.height.at<float>(3, 3) = std::numeric_limits<float>::quiet_NaN();
  EXPECT_THROW(HeightField{surface}, std::invalid_argument);
  surface = plain([](double, double) { return 0.0; });
  surface.luminance = surface.luminance(cv::Rect(0, 0, 100, 100));
  EXPECT_THROW(HeightField{surface}, std::invalid_argument);
}

TEST(HeightField, LeavesBlackOutOfTheMeanLuminance) {
  Surface surface = plain([](double, double) { return 0.0; }, 90);
  surface.luminance(cv::Rect(0, 0, 1200, 2000)).setTo(0);
  EXPECT_NEAR(HeightField(surface).mean_luminance(), 90, 1);
}

CameraEffectOptions no_effects() {
  CameraEffectOptions o;
  o.exposure_ms = o.gain_stddev = o.vignetting = o.shot_noise = o.read_noise = 0;
  o.jpeg_quality = 0;
  return o;
}

class Effects : public testing::Test {
 protected:
  Effects() : surface_(plain([](double, double) { return 0.0; }, 100)), field_(surface_) {}

  cv::Mat expose(const CameraEffectOptions& options, const CameraPose& begin, const CameraPose& end) {
    const CameraModel camera = rural_camera();
    const HeightField field(surface_);
    const RayCaster caster(field, camera);
    const CameraPose pose = looking_down({0, 0, 110});
    return CameraEffects(options, camera, 3).expose(caster.render(pose), caster, {{begin}, {pose}, {end}}, 1.0, 0);
  }
  cv::Mat expose(const CameraEffectOptions& options) {
    return expose(options, looking_down({0, 0, 110}), looking_down({0, 0, 110}));
  }

  Surface surface_;
  HeightField field_;
};

TEST_F(Effects, AtZeroLeaveTheLightAsItIs) {
  double low, high;
  cv::minMaxLoc(expose(no_effects()), &low, &high);
  EXPECT_EQ(low, 100);
  EXPECT_EQ(high, 100);
}

TEST_F(Effects, ExposureDriftsAroundTheMeanLevel) {
  CameraEffectOptions options = no_effects();
  options.mean_level = 120;
  for (const double gain : CameraEffects(options, rural_camera(), 3).gains(50, 0.1, 80)) EXPECT_DOUBLE_EQ(gain, 1.5);
  options.gain_stddev = 0.06;
  const std::vector<double> gains = CameraEffects(options, rural_camera(), 3).gains(100000, 0.1, 80);
  double square = 0;
  for (const double gain : gains) square += std::pow(std::log(gain / 1.5), 2);
  EXPECT_NEAR(std::sqrt(square / static_cast<double>(gains.size())), 0.06, 0.006);
}

TEST_F(Effects, TheGainJumpsUpAndDownByItsFactor) {
  CameraEffectOptions options = no_effects();
  options.mean_level = 120;
  options.gain_step = std::log(2.0);
  options.gain_step_s = 5;
  const std::vector<double> gains = CameraEffects(options, rural_camera(), 3).gains(1000, 0.1, 80);
  std::vector<size_t> jumps;
  for (size_t i = 1; i < gains.size(); ++i) {
    const double factor = gains[i] / gains[i - 1];
    if (factor == 1) continue;
    jumps.push_back(i);
    EXPECT_NEAR(std::abs(std::log(factor)), std::log(2.0), 1e-12);
  }
  ASSERT_EQ(jumps.size(), 20U);
  for (size_t i = 1; i < jumps.size(); ++i) EXPECT_NEAR(static_cast<double>(jumps[i] - jumps[i - 1]), 50, 1);
  EXPECT_NEAR(std::sqrt(gains[jumps[0]] * gains[jumps[1]]), 1.5, 1e-9) << "around the mean level";
}

TEST_F(Effects, NoiseHasTheVarianceOfItsModel) {
  CameraEffectOptions options = no_effects();
  options.shot_noise = 0.15;
  options.read_noise = 1.2;
  cv::Scalar mean, deviation;
  cv::meanStdDev(expose(options), mean, deviation);
  EXPECT_NEAR(mean[0], 100, 0.1);
  // The last term is the rounding to whole grey levels.
  EXPECT_NEAR(deviation[0], std::sqrt(0.15 * 100 + 1.2 * 1.2 + 1.0 / 12), 0.05);
}

TEST_F(Effects, VignettingDarkensTheCorners) {
  CameraEffectOptions options = no_effects();
  options.vignetting = 0.25;
  const cv::Mat image = expose(options);
  EXPECT_NEAR(image.at<uint8_t>(240, 320), 100, 1);
  EXPECT_NEAR(image.at<uint8_t>(0, 0), 75, 3);
}

TEST_F(Effects, MotionBlursAnEdgeOverTheWayItMoves) {
  // West of the camera dark, east of it light; the camera turns by 8 pixels about its x-z plane in the exposure.
  surface_.luminance(cv::Rect(1000, 0, 1000, 2000)).setTo(180);
  surface_.luminance(cv::Rect(0, 0, 1000, 2000)).setTo(60);
  const double angle = 4.0 / rural_camera().focal();
  const cv::Mat still = expose(no_effects());
  const cv::Mat moved =
      expose(no_effects(), looking_down({0, 0, 110}, {0, -angle, 0}), looking_down({0, 0, 110}, {0, angle, 0}));
  const auto edge_width = [](const cv::Mat& image) {  // pixels from 20 % to 80 % of the step
    int count = 0;
    for (int x = 200; x < 440; ++x) count += image.at<uint8_t>(240, x) > 84 && image.at<uint8_t>(240, x) < 156 ? 1 : 0;
    return count;
  };
  EXPECT_LE(edge_width(still), 2);
  EXPECT_NEAR(edge_width(moved), 0.6 * 8, 1.5);
}

TEST_F(Effects, AJpegIsAPictureAndRawIsItsRows) {
  CameraEffectOptions options = no_effects();
  const CameraModel camera = rural_camera();
  const cv::Mat image = expose(options);
  EXPECT_EQ(CameraEffects(options, camera, 3).encode(image).size(), 640U * 480U);
  options.jpeg_quality = 90;
  const std::vector<uint8_t> jpeg = CameraEffects(options, camera, 3).encode(image);
  EXPECT_EQ(jpeg[0], 0xff);
  EXPECT_EQ(jpeg[1], 0xd8);
}

}  // namespace
}  // namespace orthonav::simulate
