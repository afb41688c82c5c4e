// What orthonav-export writes is read back by GDAL, which knows these formats.
#include "tools/export/export.h"

#include <fstream>
#include <memory>
#include <sstream>

#include <gdal_priv.h>
#include <gtest/gtest.h>
#include <ogrsf_frmts.h>

#include "common/bus/channels.h"
#include "common/flightlog/flightlog.h"
#include "common/geo/enu_frame.h"
#include "tests/support/temporary_folder.h"

namespace orthonav::exporting {
namespace {

class Export : public ::testing::Test {
 protected:
  Export() {
    GDALAllRegister();
    CPLSetConfigOption("GPX_ELE_AS_25D", "YES");
    LogWriter log(folder_.path() / "flight.lcm");
    const EnuFrame frame({44.6, 5.1, 600.0});
    for (int k = 0; k < 20; ++k) {
      nav_state_t nav{};
      nav.utime = 1'718'445'600'000'000 + 100'000 * k;
      nav.mode = nav_state_t::MAP_AIDED;
      nav.reset_counter = k < 15 ? 1 : 2;
      const Geodetic place = frame.to_geodetic({10.0 * k, 5.0 * k, 100.0 + k});
      nav.latitude_deg = k < 2 ? std::nan("") : place.latitude_deg;
      nav.longitude_deg = place.longitude_deg;
      nav.ellipsoidal_height = place.height;
      nav.anchor_latitude_deg = 44.6;
      nav.anchor_longitude_deg = 5.1;
      nav.anchor_height = 600.0;
      nav.q_G_B[0] = 1.0;
      for (int axis = 0; axis < 3; ++axis) nav.covariance[7 * axis] = 1.0;
      log.write(nav.utime, channel::kNavState, nav);
      nav.source = nav_state_t::INERTIAL;
      nav.utime += 50'000;
      log.write(nav.utime, channel::kNavState, nav);
    }
  }
  Track read(double every = 0.0) const { return Track::read(folder_.path() / "flight.lcm", every, false); }

  // The points of the first line in a file, as GDAL reads them; `lines`: how many lines there are in it.
  std::vector<OGRPoint> points_of(const std::string& name, int* lines = nullptr) const {
    const std::string file = (folder_.path() / name).string();
    const std::unique_ptr<GDALDataset> data(
        static_cast<GDALDataset*>(GDALOpenEx(file.c_str(), GDAL_OF_VECTOR, nullptr, nullptr, nullptr)));
    std::vector<OGRPoint> points;
    if (!data) return points;
    for (OGRLayer* layer : data->GetLayers()) {
      for (const auto& feature : *layer) {
        const OGRGeometry* geometry = feature->GetGeometryRef();
        if (geometry == nullptr) continue;
        const OGRLineString* line = nullptr;
        if (wkbFlatten(geometry->getGeometryType()) == wkbLineString) line = geometry->toLineString();
        if (wkbFlatten(geometry->getGeometryType()) == wkbMultiLineString) {
          const OGRMultiLineString* all = geometry->toMultiLineString();
          if (lines != nullptr) *lines = all->getNumGeometries();
          line = all->getGeometryRef(0);
        }
        if (line == nullptr) continue;
        for (const OGRPoint& point : *line) points.push_back(point);
        return points;
      }
    }
    return points;
  }
  test::TemporaryFolder folder_;
};

void expect_same(const std::vector<OGRPoint>& points, const Track& track, double separation) {
  ASSERT_GE(points.size(), 13U);
  for (size_t k = 0; k < points.size(); ++k) {
    EXPECT_NEAR(points[k].getX(), track.states[k].longitude_deg, 1e-8);
    EXPECT_NEAR(points[k].getY(), track.states[k].latitude_deg, 1e-8);
    EXPECT_NEAR(points[k].getZ(), track.states[k].ellipsoidal_height - separation, 1e-3);
  }
}

TEST_F(Export, TakesTheLocatedStatesAtTheImagesTimes) {
  EXPECT_EQ(read().states.size(), 18U);
  EXPECT_EQ(read(0.5).states.size(), 4U);
  EXPECT_EQ(Track::read(folder_.path() / "flight.lcm", 0.0, true).states.size(), 18U);
}

TEST_F(Export, GeoJsonIsReadBack) {
  const Track track = read();
  std::ofstream out(folder_.path() / "flight.geojson");
  write_geojson(track, out);
  out.close();
  const auto points = points_of("flight.geojson");
  ASSERT_EQ(points.size(), track.states.size());
  expect_same(points, track, 0.0);
}

TEST_F(Export, KmlIsReadBackOverTheGeoid) {
  const Track track = read();
  std::ofstream out(folder_.path() / "flight.kml");
  write_kml(track, 50.0, out);
  out.close();
  const auto points = points_of("flight.kml");
  ASSERT_EQ(points.size(), track.states.size());
  expect_same(points, track, 50.0);
}

TEST_F(Export, GpxIsReadBackWithASegmentAfterAReset) {
  const Track track = read();
  std::ofstream out(folder_.path() / "flight.gpx");
  write_gpx(track, 50.0, out);
  out.close();
  int lines = 0;
  const auto points = points_of("flight.gpx", &lines);
  EXPECT_EQ(points.size(), 13U);
  EXPECT_EQ(lines, 2);
  expect_same(points, track, 50.0);
}

TEST_F(Export, TumHasSecondsPositionAndQuaternion) {
  std::stringstream out;
  write_tum(read(), out);
  double t = 0, x = 0, y = 0, z = 0, qx = 0, qy = 0, qz = 0, qw = 0;
  out >> t >> x >> y >> z >> qx >> qy >> qz >> qw;
  EXPECT_NEAR(t, 1718445600.2, 1e-6);
  EXPECT_NEAR(x, 20.0, 1e-3);
  EXPECT_NEAR(y, 10.0, 1e-3);
  EXPECT_NEAR(z, 102.0, 1e-3);
  EXPECT_EQ(qw, 1.0);
}

TEST_F(Export, ALogWithoutPositionsIsAnError) {
  LogWriter(folder_.path() / "empty.lcm");
  EXPECT_THROW(Track::read(folder_.path() / "empty.lcm", 0.0, false), std::runtime_error);
}

}  // namespace
}  // namespace orthonav::exporting
