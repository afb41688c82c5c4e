#include "services/output/nmea.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdlib>
#include <ctime>
#include <numbers>

#include <Eigen/Eigenvalues>
#include <fmt/format.h>

namespace orthonav::output {
namespace {

constexpr double kKnotsPerMetrePerSecond = 3600.0 / 1852.0;
constexpr double kDegPerRad = 180.0 / std::numbers::pi;
// Dilution of precision is a ratio; readers turn it into metres by about this much for a plain receiver.
constexpr double kMetresPerDilution = 5.0;

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

std::string gga(const Report& report, const NmeaOptions& options) {
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

std::string rmc(const Report& report, const NmeaOptions& options) {
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

std::string gst(const Report& report, const NmeaOptions& options) {
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
