#include "services/output/nmea.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdlib>
#include <ctime>
#include <limits>
#include <numbers>

#include <Eigen/Eigenvalues>
#include <fmt/format.h>

namespace orthonav::output {
namespace {

constexpr double kKnotsPerMetrePerSecond = 3600.0 / 1852.0;
constexpr double kDegPerRad = 180.0 / std::numbers::pi;
// Dilution of precision is a ratio; readers turn it into metres by about this much for a plain receiver.
constexpr double kMetresPerDilution = 5.0;

// What no aircraft reports. A sentence has no room for it and a reader no use: it is no position, no velocity, no time.
constexpr double kHighest = 1e5;                      // m above or below the ellipsoid
constexpr double kFastest = 1e4;                      // m/s
constexpr double kLargestVariance = 1e10;             // m^2
constexpr double kLargestSeparation = 1e4;            // m
constexpr int64_t kLastTime = 4'102'444'800'000'000;  // microseconds: the year 2100

struct Clock {
  std::string time, date;  // hhmmss.sss, ddmmyy
};

Clock clock_of(int64_t utime) {
  const int64_t ms = utime / 1000;
  const std::time_t seconds = static_cast<std::time_t>(ms / 1000);
  std::tm utc{};
  gmtime_r(&seconds, &utc);
  return {fmt::format("{:02}{:02}{:02}.{:03}", utc.tm_hour, utc.tm_min, utc.tm_sec, ms % 1000),
          fmt::format("{:02}{:02}{:02}", utc.tm_mday, utc.tm_mon + 1, utc.tm_year % 100)};
}

// Degrees and minutes with five decimals (2 cm), and the hemisphere.
std::string angle(double degrees, int width, char positive, char negative) {
  // Rounded as a whole: 59.999999 minutes are the next degree, not 60.00000 minutes.
  const auto units = std::llround(std::abs(degrees) * 60.0 * 1e5);
  const long long whole = units / 6'000'000;
  const double minutes = static_cast<double>(units % 6'000'000) * 1e-5;
  return fmt::format("{:0{}}{:08.5f},{}", whole, width, minutes, degrees < 0 ? negative : positive);
}

// The report with all that is absurd in it taken for unknown.
Report checked(const Report& given, const NmeaOptions& options) {
  Report report = given;
  const Eigen::Vector3d variances = report.covariance.diagonal();
  // Written so that what is not a number fails.
  const bool on_earth = std::abs(report.latitude_deg) <= 90 && std::abs(report.longitude_deg) <= 360 &&
                        std::abs(report.ellipsoidal_height) <= kHighest &&
                        std::abs(options.geoid_separation) <= kLargestSeparation;
  const bool bounded = report.covariance.allFinite() && variances.minCoeff() >= 0 &&
                       report.covariance.cwiseAbs().maxCoeff() <= kLargestVariance;
  if (!on_earth || !bounded) report.quality = Quality::kNone;
  if (!(report.velocity_enu.cwiseAbs().maxCoeff() <= kFastest) || !report.velocity_enu.allFinite())
    report.velocity_enu.setConstant(std::numeric_limits<double>::quiet_NaN());
  report.utime = std::clamp<int64_t>(report.utime, 0, kLastTime);
  return report;
}

std::string position(const Report& report) {
  if (report.quality == Quality::kNone) return ",,,";
  const double longitude = std::remainder(report.longitude_deg, 360.0);
  return angle(report.latitude_deg, 2, 'N', 'S') + "," + angle(longitude, 3, 'E', 'W');
}

}  // namespace

std::string sentence(const std::string& body) {
  unsigned checksum = 0;
  for (const char c : body) checksum ^= static_cast<unsigned char>(c);
  return fmt::format("${}*{:02X}\r\n", body, checksum);
}

std::string gga(const Report& given, const NmeaOptions& options) {
  const Report report = checked(given, options);
  std::string body = fmt::format("{}GGA,{},{},", options.talker, clock_of(report.utime).time, position(report));
  if (report.quality == Quality::kNone) {
    body += "0,00,,,M,,M,,";
  } else {
    const double horizontal = std::sqrt(0.5 * (report.covariance(0, 0) + report.covariance(1, 1)));
    body += fmt::format("{},{:02},{:.1f},{:.2f},M,{:.2f},M,,", report.quality == Quality::kAided ? 1 : 6,
                        std::clamp(report.num_fixes, 0, 99), horizontal / kMetresPerDilution,
                        report.ellipsoidal_height - options.geoid_separation, options.geoid_separation);
  }
  return sentence(body);
}

std::string rmc(const Report& given, const NmeaOptions& options) {
  const Report report = checked(given, options);
  const Clock clock = clock_of(report.utime);
  std::string motion = ",";
  if (report.quality != Quality::kNone && report.velocity_enu.allFinite()) {
    const Eigen::Vector2d v = report.velocity_enu.head<2>();
    const double course = std::atan2(v.x(), v.y()) * kDegPerRad;
    motion = fmt::format("{:.3f},{:.2f}", v.norm() * kKnotsPerMetrePerSecond, course < 0 ? course + 360.0 : course);
  }
  const bool valid = report.quality != Quality::kNone;
  const char mode = report.quality == Quality::kAided ? 'A' : valid ? 'E' : 'N';
  return sentence(fmt::format("{}RMC,{},{},{},{},{},,,{}", options.talker, clock.time, valid ? 'A' : 'V',
                              position(report), motion, clock.date, mode));
}

std::string gst(const Report& given, const NmeaOptions& options) {
  const Report report = checked(given, options);
  const std::string time = clock_of(report.utime).time;
  if (report.quality == Quality::kNone) return sentence(fmt::format("{}GST,{},,,,,,,", options.talker, time));
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d> eigen(Eigen::Matrix2d(report.covariance.topLeftCorner<2, 2>()));
  const Eigen::Vector2d stddev = eigen.eigenvalues().cwiseMax(0.0).cwiseSqrt();
  const Eigen::Vector2d axis = eigen.eigenvectors().col(1);
  double bearing = std::atan2(axis.x(), axis.y()) * kDegPerRad;
  if (bearing < 0) bearing += 180.0;
  return sentence(fmt::format("{}GST,{},{:.2f},{:.2f},{:.2f},{:.1f},{:.2f},{:.2f},{:.2f}", options.talker, time,
                              stddev.norm(), stddev(1), stddev(0), bearing, std::sqrt(report.covariance(1, 1)),
                              std::sqrt(report.covariance(0, 0)), std::sqrt(report.covariance(2, 2))));
}

}  // namespace orthonav::output
