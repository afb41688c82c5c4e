// Every kind of raster that people have: built into a map, or refused with a word that names the file.
#include <cmath>
#include <functional>
#include <map>
#include <memory>
#include <utility>

#include <gdal_priv.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <ogr_spatialref.h>

#include "services/map_server/map_builder.h"
#include "tests/support/temporary_folder.h"
#include "tests/support/texture.h"

namespace orthonav::map_server {
namespace {

using testing::HasSubstr;

constexpr int kSide = 400;

// Interest points of a picture every 10 pixels, without those whose square of 73 pixels lies by more than a quarter
// outside: two rows at each border, and the corners of what is left.
constexpr int points_of(int width, int height) {
  return (width / 10 - 4) * (height / 10 - 4) - 4;
}

struct Kind {
  GDALDataType type = GDT_Byte;
  int bands = 1;
  bool alpha = false;  // of the last band
  double nodata = NAN;
  bool crs = true;
  std::vector<double> transform = {500'000, 0.3, 0, 5'300'000, 0, -0.3};
  // Of a grey value 0..255 and the pixel.
  std::function<double(int band, double grey, int u, int v)> value = [](int, double grey, int, int) { return grey; };
};

class RasterKinds : public testing::Test {
 protected:
  std::filesystem::path write(const Kind& kind) {
    GDALAllRegister();
    auto file = folder_ / "map.tif";
    GDALDataset* dataset = GetGDALDriverManager()->GetDriverByName("GTiff")->Create(file.c_str(), kSide, kSide,
                                                                                    kind.bands, kind.type, nullptr);
    if (!kind.transform.empty()) {
      std::vector<double> transform = kind.transform;
      dataset->SetGeoTransform(transform.data());
    }
    OGRSpatialReference crs;
    crs.importFromEPSG(32632);
    if (kind.crs) dataset->SetSpatialRef(&crs);
    // The texture is fixed to the ground, whatever way the pixels lie on it.
    const std::vector<double> g = kind.transform.empty() ? Kind().transform : kind.transform;
    const cv::Mat grey = test::Texture(1).picture({kSide, kSide}, [&](const Eigen::Vector2d& p) -> Eigen::Vector2d {
      return {g[0] - 500'000 + g[1] * p.x() + g[2] * p.y(), g[3] - 5'300'000 + g[4] * p.x() + g[5] * p.y()};
    });
    for (int band = 1; band <= kind.bands; ++band) {
      cv::Mat values(kSide, kSide, CV_64F);
      for (int v = 0; v < kSide; ++v) {
        for (int u = 0; u < kSide; ++u) values.at<double>(v, u) = kind.value(band, grey.at<uchar>(v, u), u, v);
      }
      GDALRasterBand* out = dataset->GetRasterBand(band);
      if (kind.alpha && band == kind.bands) out->SetColorInterpretation(GCI_AlphaBand);
      if (std::isfinite(kind.nodata)) out->SetNoDataValue(kind.nodata);
      EXPECT_EQ(out->RasterIO(GF_Write, 0, 0, kSide, kSide, values.data, kSide, kSide, GDT_Float64, 0, 0), CE_None);
    }
    GDALClose(dataset);
    return file;
  }

  MapDescription build(const Kind& kind) {
    BuildOptions options;
    options.features = FeatureKind::kRootSift;
    const auto raster = write(kind);
    const auto levels = build_map(raster, options, folder_ / "map.onmap", nullptr);
    database_ = std::make_unique<MapDatabase>(folder_ / "map.onmap");
    return levels.front();
  }

  std::string error_of(const Kind& kind) {
    try {
      build(kind);
    } catch (const std::runtime_error& error) {
      EXPECT_FALSE(std::filesystem::exists(folder_ / "map.onmap"));
      EXPECT_FALSE(std::filesystem::exists(folder_ / "map.onmap.unfinished"));
      return error.what();
    }
    return "no error";
  }

  test::TemporaryFolder folder_;
  std::unique_ptr<MapDatabase> database_;
};

TEST_F(RasterKinds, WithoutAGeoreferenceOrACoordinateSystemAreRefused) {
  Kind kind;
  kind.transform.clear();
  EXPECT_THAT(error_of(kind), testing::AllOf(HasSubstr("map.tif"), HasSubstr("georeference")));
  kind = Kind();
  kind.crs = false;
  EXPECT_THAT(error_of(kind), testing::AllOf(HasSubstr("map.tif"), HasSubstr("coordinate reference system")));
  kind = Kind();
  kind.transform = {500'000, 0, 0, 5'300'000, 0, 0};
  EXPECT_THAT(error_of(kind), HasSubstr("map.tif"));
}

TEST_F(RasterKinds, OneBlockLargerThanMemoryShouldBeIsRefused) {
  GDALAllRegister();
  const auto file = folder_ / "map.tif";
  char sparse[] = "SPARSE_OK=TRUE", tiled[] = "TILED=YES", width[] = "BLOCKXSIZE=40000", height[] = "BLOCKYSIZE=40000";
  char* options[] = {sparse, tiled, width, height, nullptr};
  GDALDataset* dataset =
      GetGDALDriverManager()->GetDriverByName("GTiff")->Create(file.c_str(), 40000, 40000, 1, GDT_Byte, options);
  ASSERT_NE(dataset, nullptr);
  std::vector<double> transform = Kind().transform;
  dataset->SetGeoTransform(transform.data());
  OGRSpatialReference crs;
  crs.importFromEPSG(32632);
  dataset->SetSpatialRef(&crs);
  GDALClose(dataset);
  try {
    const Raster raster(file);
    FAIL() << "opened";
  } catch (const std::runtime_error& error) {
    EXPECT_THAT(error.what(), testing::AllOf(HasSubstr("map.tif"), HasSubstr("40000x40000"), HasSubstr("TILED")));
  }
}

TEST_F(RasterKinds, AllNodataIsRefused) {
  Kind kind;
  kind.nodata = 0;
  kind.value = [](int, double, int, int) { return 0.0; };
  EXPECT_THAT(error_of(kind), testing::AllOf(HasSubstr("map.tif"), HasSubstr("no point")));
  kind = Kind();
  kind.bands = 2;
  kind.alpha = true;
  kind.value = [](int band, double grey, int, int) { return band == 2 ? 0.0 : grey; };
  EXPECT_THAT(error_of(kind), HasSubstr("no point"));
  kind = Kind();
  kind.type = GDT_Float32;
  kind.value = [](int, double, int, int) { return NAN; };
  EXPECT_NE(error_of(kind), "no error");
}

// 11 bits in 16, as satellites give them: by the type's full range there would be 8 levels of grey.
TEST_F(RasterKinds, SixteenBitsAndFloatsAreTheSameMapAsEightBits) {
  const int64_t bytes = build({}).num_features;
  EXPECT_EQ(bytes, points_of(kSide, kSide));
  const TileFeatures expected = database_->all_tiles(0);
  for (const GDALDataType type : {GDT_UInt16, GDT_Int16, GDT_Float32}) {
    Kind kind;
    kind.type = type;
    kind.value = [](int, double grey, int, int) { return 8 * grey + 100; };
    EXPECT_EQ(build(kind).num_features, bytes) << type;
    const TileFeatures features = database_->all_tiles(0);
    double similarity = 0;
    for (size_t i = 0; i < features.descriptors.size(); ++i)
      similarity += features.descriptors[i] * expected.descriptors[i];
    EXPECT_GT(similarity / static_cast<double>(bytes), 0.97 * 512 * 512) << type;
  }
}

TEST_F(RasterKinds, OneBandAndThreeAndAlphaAreTheSameMap) {
  const int64_t one = build({}).num_features;
  Kind kind;
  kind.bands = 3;
  EXPECT_EQ(build(kind).num_features, one);
  kind.bands = 4;
  kind.alpha = true;
  kind.value = [](int band, double grey, int, int) { return band == 4 ? 255.0 : grey; };
  EXPECT_EQ(build(kind).num_features, one);
}

TEST_F(RasterKinds, TransparentAndNodataPartsAreLeftOut) {
  const auto expect_western_half = [&](const Kind& kind) {
    const MapDescription map = build(kind);
    EXPECT_GT(map.num_without_data, 200);
    EXPECT_GT(map.num_features, 200);
    for (const Eigen::Vector3f& p : database_->all_tiles(0).positions) EXPECT_LT(p.x(), 0.15F * kSide);
  };
  Kind kind;
  kind.bands = 2;
  kind.alpha = true;
  kind.value = [](int band, double grey, int u, int) { return band == 1 ? grey : u < kSide / 2 ? 255.0 : 0.0; };
  expect_western_half(kind);
  kind = Kind();
  kind.type = GDT_Int16;
  kind.nodata = -9999;
  kind.value = [](int, double grey, int u, int) { return u < kSide / 2 ? grey : -9999.0; };
  expect_western_half(kind);
}

// A raster flown along a river: its rows are no parallels. Features lie on G's grid as those of a north-up one do.
TEST_F(RasterKinds, RotatedRastersGiveTheGroundsOwnGrid) {
  Kind kind;
  const double angle = 0.4;
  kind.transform = {500'000,   0.3 * std::cos(angle), 0.3 * std::sin(angle),
                    5'300'000, 0.3 * std::sin(angle), -0.3 * std::cos(angle)};
  const MapDescription rotated = build(kind);
  EXPECT_NEAR(rotated.metres_per_pixel, 0.3 / 0.9996, 1e-4);
  EXPECT_GT(rotated.num_features, 300);
  EXPECT_GT(rotated.north_max, 20) << "it reaches north of its first pixel";
  const auto lattice = [&] {
    std::map<std::pair<long, long>, std::vector<uint8_t>> cells;
    const TileFeatures all = database_->all_tiles(0);
    const double pitch = 10 * database_->levels().front().metres_per_pixel;
    for (size_t i = 0; i < all.positions.size(); ++i) {
      const double column = all.positions[i].x() / pitch - 0.55, row = all.positions[i].y() / pitch + 0.55;
      EXPECT_NEAR(column, std::round(column), 1e-3);
      EXPECT_NEAR(row, std::round(row), 1e-3);
      const auto first = all.descriptors.begin() + static_cast<std::ptrdiff_t>(i * 128);
      cells[{std::lround(column), std::lround(row)}] = {first, first + 128};
    }
    return cells;
  };
  const auto turned = lattice();
  build({});
  double similarity = 0;
  int common = 0;
  for (const auto& [cell, descriptor] : lattice()) {
    const auto other = turned.find(cell);
    // Away from the rims of both.
    if (other == turned.end() || cell.first < 4 || cell.second > -4 || cell.first > 12 || cell.second < -12) continue;
    ++common;
    for (size_t k = 0; k < 128; ++k) similarity += descriptor[k] * other->second[k];
  }
  ASSERT_GT(common, 20);
  EXPECT_GT(similarity / common, 0.9 * 512 * 512) << "the same ground is described alike";
}

TEST_F(RasterKinds, LevelsAreTheSameGroundAtTwiceThePixels) {
  BuildOptions options;
  options.features = FeatureKind::kRootSift;
  options.levels = 2;
  options.tile_size_m = 30;
  const auto levels = build_map(write({}), options, folder_ / "levels.onmap", nullptr);
  ASSERT_EQ(levels.size(), 2u);
  EXPECT_NEAR(levels[1].metres_per_pixel, 2 * levels[0].metres_per_pixel, 1e-12);
  EXPECT_EQ(levels[1].tile_size, 60);
  EXPECT_NE(levels[1].fingerprint, levels[0].fingerprint);
  EXPECT_EQ(levels[0].num_features, points_of(kSide, kSide));
  EXPECT_EQ(levels[1].num_features, points_of(kSide / 2, kSide / 2));
}

}  // namespace
}  // namespace orthonav::map_server
