// NMEA sentences against what the standard says they look like.
#include "services/output/nmea.h"

#include <cmath>
#include <sstream>
#include <string>
#include <vector>

#include <gtest/gtest.h>

namespace orthonav::output {
namespace {

Report somewhere() {
  Report report;
  report.utime = 1'718'445'600'250'000;  // 2024-06-15 10:00:00.250 UTC
  report.quality = Quality::kAided;
  report.latitude_deg = -33.5;
  report.longitude_deg = 151.25;
  report.ellipsoidal_height = 123.456;
  report.velocity_enu = Eigen::Vector3d(-3.0, 4.0, 0.5);
  report.covariance = Eigen::Vector3d(4.0, 1.0, 9.0).asDiagonal();
  report.num_fixes = 7;
  return report;
}

std::vector<std::string> fields(const std::string& text) {
  std::vector<std::string> result;
  std::stringstream stream(text.substr(0, text.find('*')));
  for (std::string field; std::getline(stream, field, ',');) result.push_back(field);
  return result;
}

TEST(Nmea, ChecksumIsTheExclusiveOrOfTheBody) {
  // The worked example that every description of the format has.
  EXPECT_EQ(sentence("GPGLL,5057.970,N,00146.110,E,142451,A"), "$GPGLL,5057.970,N,00146.110,E,142451,A*27\r\n");
}

TEST(Nmea, GgaHasTimePositionQualityAndHeights) {
  NmeaOptions options;
  options.geoid_separation = 23.456;
  const auto f = fields(gga(somewhere(), options));
  EXPECT_EQ(f[0], "$GPGGA");
  EXPECT_EQ(f[1], "100000.250");
  EXPECT_EQ(f[2] + f[3], "3330.00000S");
  EXPECT_EQ(f[4] + f[5], "15115.00000E");
  EXPECT_EQ(f[6], "1");
  EXPECT_EQ(f[9], "100.00") << "over the geoid";
  EXPECT_EQ(f[11], "23.46");
}

TEST(Nmea, RmcHasSpeedInKnotsCourseAndDate) {
  const auto f = fields(rmc(somewhere(), {}));
  EXPECT_EQ(f[2], "A");
  EXPECT_NEAR(std::stod(f[7]), 5.0 * 3600 / 1852, 1e-3);
  EXPECT_NEAR(std::stod(f[8]), 360.0 - std::atan2(3.0, 4.0) * 180 / M_PI, 0.01);
  EXPECT_EQ(f[9], "150624");
  EXPECT_EQ(f[12], "A");
}

TEST(Nmea, GstHasTheErrorEllipse) {
  const auto f = fields(gst(somewhere(), {}));
  EXPECT_EQ(f[3], "2.00");
  EXPECT_EQ(f[4], "1.00");
  EXPECT_EQ(f[5], "90.0") << "the larger axis lies east";
  EXPECT_EQ(f[6], "1.00") << "of the latitude";
  EXPECT_EQ(f[7], "2.00");
  EXPECT_EQ(f[8], "3.00");
}

TEST(Nmea, WithoutAPositionThereIsNone) {
  Report report = somewhere();
  report.quality = Quality::kNone;
  report.latitude_deg = report.longitude_deg = report.ellipsoidal_height = std::nan("");
  report.covariance.setConstant(std::nan(""));
  for (const std::string& text : {gga(report, {}), rmc(report, {}), gst(report, {})}) {
    EXPECT_EQ(text.find("nan"), std::string::npos) << text;
  }
  EXPECT_EQ(fields(gga(report, {}))[6], "0");
  EXPECT_EQ(fields(rmc(report, {}))[2], "V");
}

TEST(Nmea, AnUnknownVelocityLeavesItsFieldsEmpty) {
  Report report = somewhere();
  report.velocity_enu.setConstant(std::nan(""));
  const auto f = fields(rmc(report, {}));
  EXPECT_EQ(f[7] + f[8], "");
  EXPECT_EQ(f[9], "150624");
}

TEST(Nmea, MinutesNeverReachSixtyAndLongitudesWrap) {
  Report report = somewhere();
  report.latitude_deg = 47.9999999999;
  report.longitude_deg = 350.0;
  const auto f = fields(gga(report, {}));
  EXPECT_EQ(f[2] + f[3], "4800.00000N");
  EXPECT_EQ(f[4] + f[5], "01000.00000W");
}

TEST(Nmea, WhatNoAircraftReportsIsNoPosition) {
  const auto report_of = [](auto change) {
    Report report;
    report.quality = Quality::kAided;
    change(report);
    return report;
  };
  for (const Report& report : {report_of([](Report& r) { r.latitude_deg = 3.8e39; }),
                               report_of([](Report& r) { r.ellipsoidal_height = 7e283; }),
                               report_of([](Report& r) { r.longitude_deg = std::nan(""); }),
                               report_of([](Report& r) { r.covariance(2, 2) = -1; }),
                               report_of([](Report& r) { r.covariance(0, 1) = std::nan(""); })}) {
    EXPECT_NE(gga(report, {}).find(",,,,0,00,"), std::string::npos) << gga(report, {});
    EXPECT_NE(rmc(report, {}).find(",V,"), std::string::npos) << rmc(report, {});
  }
  const Report fast = report_of([](Report& r) { r.velocity_enu[0] = 1e200; });
  EXPECT_NE(rmc(fast, {}).find(",A,"), std::string::npos);
  EXPECT_EQ(rmc(fast, {}).find("inf"), std::string::npos) << rmc(fast, {});
}

}  // namespace
}  // namespace orthonav::output
