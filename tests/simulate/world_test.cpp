#include "tools/simulate/world.h"

#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <numbers>
#include <string>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <opencv2/imgproc.hpp>

#include "common/config/config.h"
#include "common/geo/raster.h"
#include "tests/support/temporary_folder.h"
#include "tools/simulate/world_light.h"
#include "tools/simulate/world_map.h"
#include "tools/simulate/world_paint.h"

namespace orthonav::simulate {
namespace {

class WorldTest : public testing::Test {
 protected:
  // A world of 120 x 90 m with the shipped differences, and `more` under `world:`.
  World make(uint64_t seed, const std::string& difference, const std::filesystem::path& map,
             const std::string& more = "") {
    ConfigNode top = ConfigNode::load(folder_.write(
        "simulate.yaml", std::string("extends: ") + ORTHONAV_SOURCE +
                             "/config/default/world.yaml\nworld:\n  east: 120\n  north: 90\n  margin: 20\n" + more));
    ConfigNode world = top.child("world");
    return make_world(world, seed, difference, map);
  }

  test::TemporaryFolder folder_;
};

bool same(const cv::Mat& a, const cv::Mat& b) {
  return a.size() == b.size() && cv::norm(a, b, cv::NORM_INF) == 0;
}

cv::Mat read(const std::filesystem::path& file) {
  const Raster raster(file);
  return raster.read_grey({0, 0, raster.width(), raster.height()});
}

TEST_F(WorldTest, SameSeedGivesSameWorldOnAnyNumberOfThreads) {
  const int threads = cv::getNumThreads();
  cv::setNumThreads(1);
  const World one = make(7, "season", folder_ / "one.tif");
  cv::setNumThreads(3);
  const World two = make(7, "season", folder_ / "two.tif");
  cv::setNumThreads(threads);
  EXPECT_TRUE(same(one.surface.luminance, two.surface.luminance));
  EXPECT_TRUE(same(one.surface.height, two.surface.height));
  EXPECT_TRUE(same(read(folder_ / "one.tif"), read(folder_ / "two.tif")));
  EXPECT_FALSE(same(one.surface.luminance, make(8, "season", "").surface.luminance));
}

TEST_F(WorldTest, CameraEpochDoesNotDependOnTheDifference) {
  const World season = make(3, "season", folder_ / "season.tif"), years = make(3, "years", folder_ / "years.tif");
  EXPECT_TRUE(same(season.surface.luminance, years.surface.luminance));
  EXPECT_TRUE(same(season.surface.height, years.surface.height));
  EXPECT_FALSE(same(read(folder_ / "season.tif"), read(folder_ / "years.tif")));
  EXPECT_TRUE(same(season.surface.luminance, make(3, "season", "").surface.luminance))
      << "nor on whether a map is made";
}

TEST_F(WorldTest, SnowHidesTheGroundFromTheCameraAndNotFromTheMap) {
  const auto contrast = [](const cv::Mat& image) {
    cv::Scalar mean, deviation;
    cv::meanStdDev(image, mean, deviation);
    return deviation[0] / mean[0];
  };
  const World bare = make(7, "season", folder_ / "bare.tif");
  const World half = make(7, "season", folder_ / "half.tif", "  snow: 0.5\n");
  const World white = make(7, "season", folder_ / "white.tif", "  snow: 1.0\n");
  EXPECT_LT(contrast(half.surface.luminance), 0.7 * contrast(bare.surface.luminance));
  EXPECT_LT(contrast(white.surface.luminance), contrast(half.surface.luminance));
  EXPECT_GT(contrast(white.surface.luminance), 0) << "shadows stay";
  EXPECT_TRUE(same(bare.surface.height, white.surface.height));
  EXPECT_TRUE(same(read(folder_ / "bare.tif"), read(folder_ / "white.tif")));
}

TEST_F(WorldTest, MapStandsWhereItsGeoreferenceSays) {
  // Without change, error, lean and noise, the map shows what the camera sees, at the same place in any coordinate
  // system.
  const std::string exact =
      "  map_detail: 0.1\n"
      "  differences:\n    names: [season, years, same]\n    same: {days_min: 0, days_max: 0, hour_min: 12, hour_max: "
      "12, "
      "pattern_change: 0, crop_change: 0,\n"
      "      tillage_change: 0, tree_change: 0, growth: 0, crown_shift: 0, building_change: 0, roof_change: 0, "
      "ground_change: 0,\n"
      "      sensor: {blur: 0, lean_deg: 0, gamma: 1, contrast: 1, tint: 0, noise: 0}}\n"
      "  hour_min: 12\n  hour_max: 12\n  land: {arable: 1, meadow: 1, pasture: 1, wood: 0, orchard: 0, farmstead: 0, "
      "pond: 0, scatter: 30, parcel_area: 800}\n";
  for (const std::string crs : {"EPSG:32633", "EPSG:3857", "EPSG:4326"}) {
    const std::filesystem::path file = folder_ / "map.tif";
    const World world = make(
        5, "same", file,
        fmt::format("{}  map_product: {{crs: \"{}\", offset_rms: 0, jpeg_quality: 0, colour: false}}\n", exact, crs));
    const Raster raster(file);
    EXPECT_NEAR(raster.metres_per_pixel({raster.width() / 2.0, raster.height() / 2.0}), 0.3, 0.001) << crs;
    Geodetic corner = raster.pixel_to_geodetic({-0.5, -0.5});
    corner.height = world.frame.anchor().height;
    EXPECT_LT(world.frame.to_enu(corner).norm(), 1e-3) << crs;
    const cv::Mat map = read(file);
    // What the surface shows at each map pixel, shifted by `shift` m.
    cv::Mat soft;
    cv::GaussianBlur(world.surface.luminance, soft, {}, 0.3 / std::sqrt(12.0) / world.surface.resolution);
    const auto likeness = [&](const Eigen::Vector2d& shift) -> double {
      cv::Mat places(map.size(), CV_32FC2), seen;
      for (int v = 0; v < map.rows; ++v) {
        for (int u = 0; u < map.cols; ++u) {
          Geodetic p = raster.pixel_to_geodetic({static_cast<double>(u), static_cast<double>(v)});
          p.height = world.frame.anchor().height;
          const Eigen::Vector2d q = world.frame.to_enu(p).head<2>() + shift;
          places.at<cv::Vec2f>(v, u) = {
              static_cast<float>((q.x() - world.surface.east_min) / world.surface.resolution - 0.5),
              static_cast<float>((world.surface.north_max - q.y()) / world.surface.resolution - 0.5)};
        }
      }
      cv::remap(soft, seen, places, cv::Mat(), cv::INTER_LINEAR);
      cv::Mat result;
      cv::matchTemplate(seen, map, result, cv::TM_CCOEFF_NORMED);
      return result.at<float>(0, 0);
    };
    // The maximum of a parabola through three shifts along each axis.
    for (const Eigen::Vector2d& axis : {Eigen::Vector2d(1, 0), Eigen::Vector2d(0, 1)}) {
      constexpr double kStep = 0.15;
      const double below = likeness(Eigen::Vector2d(-kStep * axis)), here = likeness(Eigen::Vector2d::Zero()),
                   above = likeness(Eigen::Vector2d(kStep * axis));
      EXPECT_GT(here, below) << crs;
      EXPECT_GT(here, above) << crs;
      EXPECT_LT(std::abs(0.5 * kStep * (below - above) / (below - 2 * here + above)), 0.05) << crs;
    }
  }
}

TEST_F(WorldTest, GridNorthIsNotTrueNorth) {
  make(5, "season", folder_ / "map.tif");
  const Raster raster(folder_ / "map.tif");
  const EnuFrame frame(raster.pixel_to_geodetic({0, raster.height() - 1.0}));
  const Eigen::Vector3d up = frame.to_enu(raster.pixel_to_geodetic({0, 0}));
  // 2.02 degrees west of the zone's meridian at 48.3 degrees north: grid north lies 2.02 sin(48.3) to the west.
  EXPECT_NEAR(std::atan2(up.x(), up.y()) * 180 / std::numbers::pi, -1.51, 0.05);
}

TEST_F(WorldTest, MapOffsetHasTheConfiguredSizeAndMovesTheMap) {
  const World world = make(2, "season", "", "  map_product: {offset_rms: 2.5}\n");
  double sum = 0;
  int count = 0;
  constexpr int kNodes = 60;
  for (int j = 0; j < kNodes; ++j) {
    for (int i = 0; i < kNodes; ++i, ++count) {
      const Eigen::Vector2d p(world.map_east_min + (world.map_east_max - world.map_east_min) * (i + 0.5) / kNodes,
                              world.map_north_min + (world.map_north_max - world.map_north_min) * (j + 0.5) / kNodes);
      sum += world.map_offset(p).squaredNorm();
    }
  }
  EXPECT_NEAR(std::sqrt(sum / count), 2.5, 0.05);
}

TEST_F(WorldTest, MapShowsAPointWhereTheOffsetPutsIt) {
  const EnuFrame frame({48.3, 12.98, 430});
  Scene scene{-10, 10, 0.1, cv::Mat::zeros(500, 500, CV_8U), {}};
  const Eigen::Vector2d spot(15.05, -12.05), offset(1.2, -0.6);
  cv::circle(scene.image, cv::Point(250, 220), 6, cv::Scalar(255), cv::FILLED);
  const MapOptions options{.crs = "EPSG:3857", .colour = false, .jpeg_quality = 0};
  const MapSensor plain{.blur = 0, .lean_deg = 0, .tint = 0, .noise = 0};
  write_map(
      folder_ / "map.tif", options, plain, frame, 30, 30, scene,
      [&](const Eigen::Vector2d&) -> Eigen::Vector2d { return offset; }, 1);
  const Raster raster(folder_ / "map.tif");
  const cv::Moments m = cv::moments(read(folder_ / "map.tif"));
  Geodetic shown = raster.pixel_to_geodetic({m.m10 / m.m00, m.m01 / m.m00});
  shown.height = 430;
  EXPECT_LT((frame.to_enu(shown).head<2>() - spot - offset).norm(), 0.05);
}

TEST_F(WorldTest, LeaningViewShiftsTopsAndNotTheGround) {
  const EnuFrame frame({48.3, 12.98, 430});
  Scene scene{-10, 10, 0.1, cv::Mat::zeros(500, 500, CV_8U), cv::Mat::zeros(500, 500, CV_32F)};
  const cv::Rect tower(240, 210, 20, 20);
  scene.image(tower).setTo(255);
  const MapOptions options{.colour = false, .jpeg_quality = 0};
  MapSensor sensor{.blur = 0, .lean_deg = 20, .lean_wavelength = 0, .tint = 0, .noise = 0};
  const auto centre = [&](double height) {
    scene.above_ground(tower).setTo(height);
    write_map(
        folder_ / "map.tif", options, sensor, frame, 30, 30, scene,
        [](const Eigen::Vector2d&) { return Eigen::Vector2d(0, 0); }, 1);
    const cv::Moments m = cv::moments(read(folder_ / "map.tif"));
    return Eigen::Vector2d(0.3 * m.m10 / m.m00, 0.3 * m.m01 / m.m00);
  };
  // A roof 5 m up moves by 5 tan 20 = 1.82 m. Its walls, painted like the roof, stretch towards where it stands.
  const double moved = (centre(5.0) - centre(0.0)).norm();
  EXPECT_GT(moved, 0.5 * 1.82 - 0.1);
  EXPECT_LT(moved, 1.82 + 0.1);
}

TEST(ShadowTest, FallsAwayFromTheSunAsLongAsTheSunIsLow) {
  constexpr double kResolution = 0.1, kHeight = 5;
  for (const double azimuth_deg : {20.0, 75.0, 110.0, 160.0, 200.0, 255.0, 300.0, 350.0}) {
    const Sun sun{azimuth_deg * std::numbers::pi / 180, 40 * std::numbers::pi / 180};
    cv::Mat height = cv::Mat::zeros(301, 301, CV_32F);
    cv::circle(height, {150, 150}, 4, cv::Scalar(kHeight), cv::FILLED);
    const cv::Mat shadow = cast_shadows(height, kResolution, sun);
    const double length = kHeight / std::tan(sun.elevation);
    const auto at = [&](double distance) {  // along the shadow; image rows go south
      const double u = 150 - distance / kResolution * std::sin(sun.azimuth),
                   v = 150 + distance / kResolution * std::cos(sun.azimuth);
      return shadow.at<uint8_t>(cvRound(v), cvRound(u));
    };
    EXPECT_GT(at(0.3 * length), 200) << azimuth_deg;
    EXPECT_GT(at(0.8 * length), 200) << azimuth_deg;
    EXPECT_EQ(at(1.25 * length), 0) << azimuth_deg;
    EXPECT_EQ(at(-0.3 * length), 0) << azimuth_deg;
  }
}

TEST(SunTest, StandsWhereTheAlmanacPutsIt) {
  const double degree = std::numbers::pi / 180;
  const Sun noon = sun_at(48.0, 172, 12);  // solstice: 90 - 48 + 23.44
  EXPECT_NEAR(noon.elevation / degree, 65.44, 0.1);
  EXPECT_NEAR(std::abs(noon.azimuth) / degree, 180, 0.1);
  const Sun dawn = sun_at(48.0, 81, 6);  // equinox: due east on the horizon
  EXPECT_NEAR(dawn.elevation / degree, 0, 0.5);
  EXPECT_NEAR(dawn.azimuth / degree, 90, 0.5);
}

TEST_F(WorldTest, ElevationModelGivesEllipsoidalHeightsOfTheBareGround) {
  const World world = make(4, "season", folder_ / "map.tif",
                           "  relief_rms: 8\n  land: {wood: 0, farmstead: 0, orchard: 0, arable: 0, scatter: 0}\n  "
                           "map_product: {dem_error_rms: 0}\n");
  const Raster dem(folder_ / "map.dem.tif");
  const cv::Mat heights = dem.read_float({0, 0, dem.width(), dem.height()});
  int compared = 0, alike = 0;
  for (int v = 0; v < dem.height(); ++v) {
    for (int u = 0; u < dem.width(); ++u) {
      Geodetic p = dem.pixel_to_geodetic({static_cast<double>(u), static_cast<double>(v)});
      p.height = heights.at<float>(v, u);
      const Eigen::Vector3d g = world.frame.to_enu(p);
      const cv::Point pixel(static_cast<int>((g.x() - world.surface.east_min) / world.surface.resolution),
                            static_cast<int>((world.surface.north_max - g.y()) / world.surface.resolution));
      if (!cv::Rect({0, 0}, world.surface.height.size()).contains(pixel)) continue;
      ++compared;
      // Grass is up to 0.4 m high; a tree may stand at a node or two.
      const double above = world.surface.height.at<float>(pixel) - g.z();
      if (above > -0.1 && above < 0.5) ++alike;
    }
  }
  EXPECT_GE(alike, 0.8 * compared);
  EXPECT_GE(compared, 6);
  EXPECT_NEAR(world.ground_height, 0, 20);
}

TEST_F(WorldTest, BoundsLieInsideTheTurnedMap) {
  const World world = make(4, "season", folder_ / "map.tif");
  const Raster raster(folder_ / "map.tif");
  for (const double e : {world.map_east_min, world.map_east_max}) {
    for (const double n : {world.map_north_min, world.map_north_max}) {
      const Eigen::Vector2d pixel = raster.geodetic_to_pixel(world.frame.to_geodetic({e, n, 0}));
      EXPECT_GT(pixel.minCoeff(), -0.6);
      EXPECT_LT(pixel.x(), raster.width() - 0.4);
      EXPECT_LT(pixel.y(), raster.height() - 0.4);
    }
  }
}

TEST_F(WorldTest, RefusesWhatItDoesNotUnderstand) {
  const auto error = [&](const std::string& difference, const std::string& more) -> std::string {
    try {
      make(1, difference, folder_ / "map.tif", more);
    } catch (const std::exception& e) {
      return e.what();
    }
    return "";
  };
  EXPECT_THAT(error("season", "  releif_rms: 3\n"), testing::HasSubstr("releif_rms"));
  EXPECT_THAT(error("season", "  land: {wod: 1}\n"), testing::HasSubstr("wod"));
  EXPECT_THAT(error("season", "  differences: {season: {sensor: {blurr: 1}}}\n"), testing::HasSubstr("blurr"));
  EXPECT_THAT(error("decades", ""), testing::HasSubstr("decades"));
  EXPECT_THAT(error("season", "  map_product: {crs: EPSG:99999999}\n"), testing::HasSubstr("EPSG:99999999"));
  EXPECT_THAT(error("season", "  hour_min: 5\n"), testing::HasSubstr("hour_min"));
  EXPECT_THAT(error("season", "  ortho: missing.tif\n  map: missing.tif\n  area: [0, 0, 1, 1]\n"),
              testing::HasSubstr("missing.tif"));
  EXPECT_THAT(error("season", "  surface: dsm.tif\n"), testing::HasSubstr("surface"));
}

TEST_F(WorldTest, RealOrthophotosBecomeAWorld) {
  const char* variable = std::getenv("ORTHONAV_DATA");
  const std::filesystem::path data =
      variable != nullptr ? std::filesystem::path(variable) : std::filesystem::path(ORTHONAV_SOURCE) / "../shared/data";
  const std::filesystem::path village = std::filesystem::absolute(data) / "portugal_village";
  if (!std::filesystem::exists(village / "dsm.tif")) GTEST_SKIP() << "no real data in " << village;
  const std::string ortho = (village / "ortho_0.06m_utm29.tif").string();
  const World world =
      make(1, "season", folder_ / "map.tif",
           "  ortho: " + ortho + "\n  map: " + ortho + "\n  surface: " + (village / "dsm.tif").string() +
               "\n  area: [554150, 4505850, 554230, 4505910]\n  anchor: {height: 0}\n  map_product: {crs: "
               "\"EPSG:32629\", colour: false}\n");
  EXPECT_GT(cv::mean(world.surface.luminance)[0], 30);
  double low = 0, high = 0;
  cv::minMaxLoc(world.surface.height, &low, &high);
  EXPECT_GT(low, -20);
  EXPECT_LT(high, 50);
  EXPECT_GT(high - low, 5);
  const Raster source(ortho), map(folder_ / "map.tif");
  // The same grey at the same place of the Earth, smoothed over what a map pixel gathers.
  const cv::Mat shown = read(folder_ / "map.tif");
  cv::Mat expected(shown.size(), CV_8U);
  cv::Mat whole = source.read_grey({0, 0, source.width(), source.height()}), soft;
  cv::GaussianBlur(whole, soft, {}, 0.3 / 0.06 / std::sqrt(12.0));
  for (int v = 0; v < shown.rows; ++v)
    for (int u = 0; u < shown.cols; ++u) {
      const Eigen::Vector2d p =
          source.geodetic_to_pixel(map.pixel_to_geodetic({static_cast<double>(u), static_cast<double>(v)}));
      expected.at<uint8_t>(v, u) = soft.at<uint8_t>(cvRound(p.y()), cvRound(p.x()));
    }
  cv::Mat result;
  cv::matchTemplate(expected, shown, result, cv::TM_CCOEFF_NORMED);
  EXPECT_GT(result.at<float>(0, 0), 0.97);
}

}  // namespace
}  // namespace orthonav::simulate
