// Positions as NMEA 0183 sentences, as a GNSS receiver would say them: GGA, RMC and GST.
//
// Pure functions, thread-safe.
#pragma once

#include <cstdint>
#include <limits>
#include <string>

#include <Eigen/Core>

namespace orthonav::output {

// How much a position is worth to whoever reads it.
enum class Quality {
  kNone,       // no position: GGA quality 0, RMC status V, mode N
  kEstimated,  // carried on without fixes: GGA quality 6, RMC status A, mode E
  kAided,      // aided by the map: GGA quality 1, RMC status A, mode A
};

struct Report {
  int64_t utime = 0;  // microseconds since the Unix epoch
  Quality quality = Quality::kNone;
  double latitude_deg = 0.0;                                 // WGS84
  double longitude_deg = 0.0;                                // (-180, 180] or any equivalent
  double ellipsoidal_height = 0.0;                           // m
  Eigen::Vector3d velocity_enu = Eigen::Vector3d::Zero();    // m/s; NaN: unknown
  Eigen::Matrix3d covariance = Eigen::Matrix3d::Identity();  // of the position, east north up, m^2
  int num_fixes = 0;                                         // in the place of satellites
};

struct NmeaOptions {
  std::string talker = "GP";      // two letters before the sentence's name
  double geoid_separation = 0.0;  // m, of the geoid over the ellipsoid in the area of the flight
};

// One sentence each, with checksum, CR and LF. Fields that are unknown are empty, and so are those that no aircraft
// reports: a position off the Earth, or with a covariance that is none, is no position, a velocity of 10 km/s no
// velocity.
std::string gga(const Report& report, const NmeaOptions& options);
std::string rmc(const Report& report, const NmeaOptions& options);
// Standard deviations; empty fields without a position.
std::string gst(const Report& report, const NmeaOptions& options);

// "$" body "*" checksum CR LF.
std::string sentence(const std::string& body);

}  // namespace orthonav::output
