#include <cmath>
#include <filesystem>
#include <fstream>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "common/geo/enu_frame.h"
#include "common/geo/raster.h"

namespace orthonav {
namespace {

const Geodetic kPlace{47.5, 9.5, 400.0};

std::filesystem::path temporary(const std::string& name) {
  return std::filesystem::path(testing::TempDir()) / name;
}

TEST(EnuFrame, AxesPointEastNorthUp) {
  const EnuFrame frame(kPlace);
  EXPECT_LT(frame.to_enu(kPlace).norm(), 1e-8);
  const Eigen::Vector3d east = frame.to_enu({47.5, 9.501, 400}), north = frame.to_enu({47.501, 9.5, 400});
  EXPECT_NEAR(east.x(), 75.3, 0.3);  // a thousandth of a degree at this latitude
  EXPECT_NEAR(east.y(), 0, 0.01);
  EXPECT_NEAR(north.y(), 111.2, 0.2);
  EXPECT_NEAR(frame.to_enu({47.5, 9.5, 410}).z(), 10, 1e-8);
}

TEST(EnuFrame, GeodeticRoundTripIsExact) {
  const EnuFrame frame(kPlace);
  const Eigen::Vector3d p(1234.5, -4321.0, 285.0);
  EXPECT_LT((frame.to_enu(frame.to_geodetic(p)) - p).norm(), 1e-7);
}

TEST(EnuFrame, LocalVerticalTiltsWithTheEarth) {
  const EnuFrame frame(kPlace);
  const Eigen::Vector3d p(6371.0, 0, 0);  // a thousandth of a radian to the east
  const Eigen::Matrix3d R_local_G = frame.R_local_G(p);
  const Geodetic higher = frame.to_geodetic(p);
  const Eigen::Vector3d up_G =
      (frame.to_enu({higher.latitude_deg, higher.longitude_deg, higher.height + 100}) - p) / 100;
  EXPECT_LT((R_local_G * up_G - Eigen::Vector3d::UnitZ()).norm(), 1e-9);
  EXPECT_NEAR(up_G.x(), 1e-3, 1e-5);
}

TEST(Declination, EastIsAddedToMagneticHeading) {
  EXPECT_NEAR(true_heading(0.1, 0.05), 0.15, 1e-15);
  EXPECT_NEAR(true_heading(0.1, -0.2), 2 * M_PI - 0.1, 1e-12);
}

RasterGrid grid_at(const std::string& crs, double x, double y, double step) {
  RasterGrid grid;
  grid.crs = crs;
  const double transform[6] = {x, step, 0, y, 0, -step};
  std::copy(std::begin(transform), std::end(transform), grid.transform);
  return grid;
}

TEST(Raster, PixelToGeodeticGoesThroughTheCrs) {
  const auto file = temporary("utm.tif");
  write_geotiff(file, cv::Mat(100, 80, CV_8U, cv::Scalar(7)), grid_at("EPSG:32633", 300000, 5300000, 0.3));
  const Raster raster(file);
  EXPECT_EQ(raster.width(), 80);
  EXPECT_EQ(raster.height(), 100);
  const Eigen::Vector2d pixel(13.25, 77.5);
  const Geodetic position = raster.pixel_to_geodetic(pixel);
  EXPECT_LT((raster.geodetic_to_pixel(position) - pixel).norm(), 1e-3);
  // 200 km west of UTM 33's central meridian, grid north is about 2 degrees west of true north.
  const EnuFrame frame(raster.pixel_to_geodetic({0, 0}));
  const Eigen::Vector3d up_the_grid = frame.to_enu(raster.pixel_to_geodetic({0, -1000}));
  EXPECT_NEAR(std::atan2(up_the_grid.x(), up_the_grid.y()) * 180 / M_PI, -1.98, 0.1);
  EXPECT_NEAR(raster.metres_per_pixel({40, 50}), 0.3, 0.0003);
}

TEST(Raster, ReadsLuminanceAndMarksWhatLiesOutside) {
  cv::Mat picture(20, 30, CV_8UC3, cv::Scalar(0, 0, 200));  // red
  picture.at<cv::Vec3b>(5, 6) = {255, 255, 255};
  const auto file = temporary("rgb.tif");
  write_geotiff(file, picture, grid_at("EPSG:4326", 9.5, 47.5, 3e-6));
  const Raster raster(file);
  cv::Mat valid;
  const cv::Mat grey = raster.read_grey(cv::Rect(-4, -4, 20, 12), &valid);
  ASSERT_EQ(grey.size(), cv::Size(20, 12));
  EXPECT_EQ(valid.at<uint8_t>(0, 0), 0);
  EXPECT_NE(valid.at<uint8_t>(4, 4), 0);
  EXPECT_EQ(grey.at<uint8_t>(9, 10), 255);
  EXPECT_NEAR(grey.at<uint8_t>(4, 4), 0.299 * 200, 1);
}

TEST(Raster, FloatRoundTrip) {
  cv::Mat heights(9, 9, CV_32F);
  cv::randu(heights, -20, 500);
  const auto file = temporary("dem.tif");
  write_geotiff(file, heights, grid_at("EPSG:3857", 1e6, 6e6, 10));
  EXPECT_EQ(cv::norm(Raster(file).read_float(cv::Rect(0, 0, 9, 9)), heights), 0.0);
}

TEST(Raster, EveryBadFileIsAnErrorWithItsName) {
  const auto error_of = [](const std::filesystem::path& file) -> std::string {
    try {
      const Raster raster(file);
      raster.read_grey(cv::Rect(0, 0, raster.width(), raster.height()));
    } catch (const std::runtime_error& error) {
      return error.what();
    }
    return "no error";
  };
  EXPECT_THAT(error_of("/nonexistent/map.tif"), testing::HasSubstr("/nonexistent/map.tif"));

  const auto garbage = temporary("garbage.tif");
  std::ofstream(garbage) << "this is no raster";
  EXPECT_THAT(error_of(garbage), testing::HasSubstr("garbage.tif"));

  const auto whole = temporary("whole.tif"), truncated = temporary("truncated.tif");
  cv::Mat noise(600, 600, CV_8U);
  cv::randu(noise, 0, 255);
  write_geotiff(whole, noise, grid_at("EPSG:32633", 300000, 5300000, 0.3));
  std::ifstream in(whole, std::ios::binary);
  std::vector<char> bytes((std::istreambuf_iterator<char>(in)), std::istreambuf_iterator<char>());
  std::ofstream(truncated, std::ios::binary).write(bytes.data(), static_cast<std::streamsize>(bytes.size() / 2));
  EXPECT_THAT(error_of(truncated), testing::HasSubstr("truncated.tif"));
}

}  // namespace
}  // namespace orthonav
