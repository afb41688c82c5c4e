#include "services/map_server/map_builder.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <fstream>
#include <map>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "common/features/fixed_sift.h"
#include "common/geo/raster.h"
#include "tests/support/temporary_folder.h"
#include "tests/support/texture.h"

namespace orthonav::map_server {
namespace {

using testing::HasSubstr;

constexpr double kSigma = 0.3;
// Far from the central meridian of UTM 32: grid north is 1.9 degrees from true north.
const Geodetic kCorner{48.1, 11.5, 0};

// A grid of a CRS whose first pixel has its outer corner at `corner` and whose pixels are `width` x `height` of the
// CRS's units.
RasterGrid grid_at(const std::string& crs, const Geodetic& corner, double width, double height,
                   const std::filesystem::path& scratch) {
  RasterGrid unit;
  unit.crs = crs;
  // With a unit transform, pixels are the CRS's coordinates.
  write_geotiff(scratch, cv::Mat::zeros(1, 1, CV_8U), unit);
  const Eigen::Vector2d pixel = Raster(scratch).geodetic_to_pixel(corner);
  RasterGrid grid;
  grid.crs = crs;
  const double transform[6] = {pixel.x() + 0.5, width, 0, -(pixel.y() + 0.5), 0, -height};
  std::copy(std::begin(transform), std::end(transform), std::begin(grid.transform));
  return grid;
}

// An orthophoto of the texture, which is fixed to the Earth, in this grid.
void write_orthophoto(const std::filesystem::path& file, const test::Texture& texture, const EnuFrame& earth,
                      const RasterGrid& grid, const cv::Size& size) {
  write_geotiff(file, cv::Mat::zeros(size, CV_8U), grid);
  const Raster raster(file);
  const cv::Mat image = texture.picture(size, [&](const Eigen::Vector2d& pixel) -> Eigen::Vector2d {
    return earth.to_enu(raster.pixel_to_geodetic(pixel)).head<2>();
  });
  write_geotiff(file, image, grid);
}

const MapDescription& finest(const MapDatabase& database) {
  return database.levels().front();
}

using Lattice = std::map<std::pair<long, long>, std::pair<Eigen::Vector3f, std::vector<uint8_t>>>;

Lattice lattice_of(const MapDatabase& database) {
  Lattice lattice;
  for (int t = 0; t < finest(database).num_tiles(); ++t) {
    const TileFeatures tile = database.tile(0, t);
    for (size_t i = 0; i < tile.positions.size(); ++i) {
      const auto descriptor = tile.descriptors.begin() + static_cast<std::ptrdiff_t>(i * kSiftBytes);
      lattice[{std::lround(tile.positions[i].x() / 3), std::lround(tile.positions[i].y() / 3)}] = {
          tile.positions[i], {descriptor, descriptor + kSiftBytes}};
    }
  }
  return lattice;
}

double squared_distance(const std::vector<uint8_t>& a, const uint8_t* b) {
  double sum = 0;
  for (size_t k = 0; k < a.size(); ++k) sum += (a[k] - b[k]) * (a[k] - b[k]);
  return sum;
}

class MapOfOneGround : public testing::Test {
 protected:
  test::TemporaryFolder folder_;
  test::Texture texture_{1};
  EnuFrame earth_{kCorner};

  std::filesystem::path orthophoto(const std::string& name, const std::string& crs, double width, double height,
                                   const cv::Size& size = {240, 240}) {
    auto file = folder_ / (name + ".tif");
    write_orthophoto(file, texture_, earth_, grid_at(crs, kCorner, width, height, folder_ / "unit.tif"), size);
    return file;
  }

  MapDatabase build(const std::filesystem::path& raster, const BuildOptions& options) {
    const auto out = raster.parent_path() / (raster.stem().string() + ".onmap");
    build_map(raster, options, out, nullptr);
    return MapDatabase(out);
  }
};

// The descriptors tell where the picture really is under them: they are compared with those of the true ground moved
// by a little to either side, and a parabola through the distances has its minimum at the error.
TEST_F(MapOfOneGround, HasTheSamePositionsFromUtmWebMercatorAndWgs84Within5Cm) {
  const double degree = 111'200.0;
  const double cosine = std::cos(kCorner.latitude_deg * M_PI / 180);
  const std::map<std::string, std::filesystem::path> rasters = {
      {"UTM", orthophoto("utm", "EPSG:32632", kSigma, kSigma)},
      {"Web Mercator", orthophoto("mercator", "EPSG:3857", kSigma / cosine, kSigma / cosine)},
      // Square in degrees, so far from square on the ground, as WGS84 rasters usually are.
      {"WGS84", orthophoto("wgs84", "EPSG:4326", kSigma / degree, kSigma / degree, {360, 240})}};
  BuildOptions options;
  options.features = FeatureKind::kGrid;
  options.metres_per_pixel = kSigma;
  std::map<std::string, Lattice> lattices;
  for (const auto& [name, raster] : rasters) {
    const MapDatabase database = build(raster, options);
    EXPECT_NEAR(finest(database).anchor.latitude_deg, kCorner.latitude_deg, 1e-8) << name;
    EXPECT_NEAR(finest(database).anchor.longitude_deg, kCorner.longitude_deg, 1e-8) << name;
    lattices[name] = lattice_of(database);
    ASSERT_GT(lattices[name].size(), 350u) << name;
  }

  // The true ground around a position, on G's own pixels, moved east and north by a little.
  const FixedSift sift(options.keypoint_size);
  const auto truth = [&](const Eigen::Vector3f& position, double east, double north) {
    const int half = sift.support();
    const cv::Mat picture = texture_.picture({2 * half + 1, 2 * half + 1}, [&](const Eigen::Vector2d& pixel) {
      return Eigen::Vector2d(position.x() + east + (pixel.x() - half) * kSigma,
                             position.y() + north - (pixel.y() - half) * kSigma);
    });
    return sift.describe(picture, {cv::Point2f(static_cast<float>(half), static_cast<float>(half))});
  };
  constexpr double kStep = 0.15;
  for (const auto& [name, lattice] : lattices) {
    for (const bool north : {false, true}) {
      std::array<double, 3> distance{};
      int used = 0;
      for (const auto& [cell, feature] : lattice) {
        const Eigen::Vector3f& position = feature.first;
        // Interest points away from the border, a sample of them.
        if (position.x() < 20 || position.x() > 50 || position.y() > -20 || position.y() < -50 || ++used % 4 != 0) {
          continue;
        }
        for (int i = -1; i <= 1; ++i) {
          const cv::Mat descriptor = truth(position, north ? 0 : i * kStep, north ? i * kStep : 0);
          distance[static_cast<size_t>(i + 1)] += squared_distance(feature.second, descriptor.ptr());
        }
      }
      ASSERT_GT(used, 80) << name;
      const double offset = 0.5 * kStep * (distance[0] - distance[2]) / (distance[0] - 2 * distance[1] + distance[2]);
      EXPECT_LT(std::abs(offset), 0.05) << name << (north ? " north" : " east");
      EXPECT_LT(distance[1], 0.5 * distance[0]) << name;
    }
    for (const auto& [cell, feature] : lattice) {
      const auto other = lattices["UTM"].find(cell);
      if (other == lattices["UTM"].end()) continue;
      EXPECT_LT((other->second.first - feature.first).norm(), 0.05) << name;
    }
  }
}

TEST_F(MapOfOneGround, PutsInterestPointsEveryTenPixelsFromTheCorner) {
  BuildOptions options;
  options.ground_height_m = 430;
  options.keypoint_size = 8;
  // In the middle of its zone, UTM is north-up, but for its scale of 0.9996.
  RasterGrid grid;
  grid.transform[0] = 500'000;
  grid.transform[1] = kSigma;
  grid.transform[3] = 5'300'000;
  grid.transform[5] = -kSigma;
  const auto file = folder_ / "north_up.tif";
  write_geotiff(file, texture_.picture({200, 150}, [](const Eigen::Vector2d& p) -> Eigen::Vector2d { return p * 0.3; }),
                grid);
  const MapDatabase database = build(file, options);
  const MapDescription& map = finest(database);
  EXPECT_NEAR(map.metres_per_pixel, kSigma / 0.9996, 1e-5);
  EXPECT_EQ(map.anchor.height, 430);
  EXPECT_EQ(map.keypoint_stride, 10);
  EXPECT_FALSE(map.has_surface);
  // 20 x 15 points, without those whose square lies by more than a quarter outside: the border's and the next corners.
  EXPECT_EQ(map.num_features, 18 * 13 - 4);
  double west = 1e9, north = -1e9;
  for (int t = 0; t < map.num_tiles(); ++t) {
    for (const Eigen::Vector3f& p : database.tile(0, t).positions) {
      EXPECT_EQ(map.tile_of(p.x(), p.y()), t);
      west = std::min(west, static_cast<double>(p.x()));
      north = std::max(north, static_cast<double>(p.y()));
      EXPECT_NEAR(p.z(), 0, 0.01);
      const double u = p.x() / map.metres_per_pixel;
      EXPECT_NEAR(u, 10 * std::round((u - 5.5) / 10) + 5.5, 1e-3);
    }
  }
  EXPECT_NEAR(west, 15.5 * map.metres_per_pixel, 1e-4);
  EXPECT_NEAR(north, -15.5 * map.metres_per_pixel, 1e-4);
}

TEST_F(MapOfOneGround, LeavesOutWhatHasNoDataAndNoTexture) {
  const RasterGrid grid = grid_at("EPSG:32632", kCorner, kSigma, kSigma, folder_ / "unit.tif");
  cv::Mat image = texture_.picture({300, 300}, [](const Eigen::Vector2d& p) -> Eigen::Vector2d { return p * 0.3; });
  image(cv::Rect(150, 0, 150, 300)).setTo(127);  // a lake
  write_geotiff(folder_ / "lake.tif", image, grid);
  const MapDescription lake = build_map(folder_ / "lake.tif", {}, folder_ / "lake.onmap", nullptr).front();
  EXPECT_GT(lake.num_without_texture, 200);
  for (int t = 0; t < lake.num_tiles(); ++t) {
    const MapDatabase database(folder_ / "lake.onmap");
    for (const Eigen::Vector3f& p : database.tile(0, t).positions) EXPECT_LT(p.x(), 63);
  }
  image.setTo(127);
  write_geotiff(folder_ / "empty.tif", image, grid);
  try {
    build_map(folder_ / "empty.tif", {}, folder_ / "empty.onmap", nullptr);
    FAIL() << "a map without any feature";
  } catch (const MapDatabaseError& error) {
    EXPECT_THAT(error.what(), HasSubstr("empty.tif"));
  }
  EXPECT_FALSE(std::filesystem::exists(folder_ / "empty.onmap"));
}

TEST_F(MapOfOneGround, TakesHeightsFromAnElevationModel) {
  const auto raster = orthophoto("hill", "EPSG:32632", kSigma, kSigma);
  // In another CRS and coarser; it rises 0.1 m for each metre east, from 500 m at the corner.
  RasterGrid grid = grid_at("EPSG:4326", {kCorner.latitude_deg + 1e-4, kCorner.longitude_deg - 1e-4, 0}, 5e-5, 5e-5,
                            folder_ / "unit.tif");
  const auto model = folder_ / "hill.dem.tif";
  cv::Mat heights(40, 40, CV_32F);
  write_geotiff(model, heights, grid);
  {
    const Raster georeference(model);
    for (int v = 0; v < heights.rows; ++v) {
      for (int u = 0; u < heights.cols; ++u) {
        const double east = earth_.to_enu(georeference.pixel_to_geodetic(Eigen::Vector2d(u, v))).x();
        heights.at<float>(v, u) = static_cast<float>(500 + 0.1 * east);
      }
    }
  }
  write_geotiff(model, heights, grid);
  BuildOptions options;  // dem: auto finds it by its name
  const MapDatabase database = build(raster, options);
  ASSERT_TRUE(finest(database).has_surface);
  const EnuFrame frame(finest(database).anchor);
  for (int t = 0; t < finest(database).num_tiles(); ++t) {
    for (const Eigen::Vector3f& p : database.tile(0, t).positions) {
      EXPECT_NEAR(frame.to_geodetic(p.cast<double>()).height, 500 + 0.1 * p.x(), 0.02);
    }
  }
  options.dem = "none";
  const MapDescription flat = build_map(raster, options, folder_ / "flat.onmap", nullptr).front();
  EXPECT_FALSE(flat.has_surface);
  EXPECT_NE(flat.fingerprint, finest(database).fingerprint);
}

TEST_F(MapOfOneGround, IsTheSameFromEveryBuild) {
  const auto raster = orthophoto("same", "EPSG:32632", kSigma, kSigma);
  const auto bytes = [&](const std::string& name) {
    build_map(raster, {}, folder_ / name, nullptr);
    std::ifstream in(folder_ / name, std::ios::binary);
    return std::string(std::istreambuf_iterator<char>(in), {});
  };
  EXPECT_EQ(bytes("a.onmap"), bytes("b.onmap"));
}

TEST_F(MapOfOneGround, KeepsTheDatabaseBesideTheRasterUntilSomethingChanges) {
  const auto raster = orthophoto("kept", "EPSG:32632", kSigma, kSigma);
  int builds = 0;
  const auto count = [&](const BuildProgress& progress) { builds += progress.done == progress.total ? 1 : 0; };
  BuildOptions options;
  const auto file = prepare_map(raster, options, count);
  EXPECT_EQ(file, raster.string() + ".rootsift.onmap");
  EXPECT_EQ(prepare_map(raster, options, count), file);
  EXPECT_EQ(builds, 1);
  options.keypoint_size = 16;
  prepare_map(raster, options, count);
  EXPECT_EQ(builds, 2);
  EXPECT_EQ(MapDatabase(file).levels().front().keypoint_size, 16);
  std::filesystem::resize_file(file, std::filesystem::file_size(file) / 2);
  prepare_map(raster, options, count);
  EXPECT_EQ(builds, 3);
  write_orthophoto(raster, test::Texture(2), earth_, grid_at("EPSG:32632", kCorner, kSigma, kSigma, folder_ / "u.tif"),
                   {240, 240});
  prepare_map(raster, options, count);
  EXPECT_EQ(builds, 4);
  EXPECT_EQ(prepare_map(file, options, count), file);
  options.features = FeatureKind::kSift;
  const auto detected = prepare_map(raster, options, count);
  EXPECT_EQ(detected, raster.string() + ".sift.onmap");
  EXPECT_EQ(MapDatabase(detected).levels().front().keypoint_size, 0);
  EXPECT_GT(MapDatabase(detected).levels().front().num_features, 100);
}

TEST_F(MapOfOneGround, ARasterThatCannotBeUsedIsNamed) {
  std::ofstream(folder_ / "text.tif") << "no picture";
  EXPECT_THROW(build_map(folder_ / "text.tif", {}, folder_ / "text.onmap", nullptr), std::runtime_error);
  const auto raster = orthophoto("whole", "EPSG:32632", kSigma, kSigma);
  std::filesystem::resize_file(raster, std::filesystem::file_size(raster) / 3);
  try {
    build_map(raster, {}, folder_ / "truncated.onmap", nullptr);
    FAIL() << "a map of a truncated raster";
  } catch (const std::runtime_error& error) {
    EXPECT_THAT(error.what(), HasSubstr("whole.tif"));
  }
  EXPECT_FALSE(std::filesystem::exists(folder_ / "truncated.onmap"));
  EXPECT_THROW(build_map(raster, {}, "/nowhere/map.onmap", nullptr), std::runtime_error);
}

TEST(BuildOptions, RefusesMisspeltKeysAndValuesOutOfRange) {
  for (const char* text :
       {"keypoint_sise: 8", "keypoint_size: 1000", "features: both", "max_invalid_fraction: 2", "levels: 0"}) {
    ConfigNode node = ConfigNode::parse(text, "map_server.yaml");
    try {
      BuildOptions::from_config(node);
      FAIL() << text;
    } catch (const ConfigError& error) {
      EXPECT_THAT(error.what(), HasSubstr("map_server.yaml:1")) << text;
    }
  }
}

}  // namespace
}  // namespace orthonav::map_server
