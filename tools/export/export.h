// A recorded flight for other programs: GeoJSON (RFC 7946), KML 2.2, GPX 1.1 and TUM trajectories.
#pragma once

#include <filesystem>
#include <ostream>
#include <vector>

#include "orthonav/nav_state_t.hpp"

namespace orthonav::exporting {

// The positions of a flight, in the order of their times: NAV_STATE with a geodetic position.
struct Track {
  std::vector<nav_state_t> states;

  // Reads a log; of the states, those at the images' times, or with `inertial` those of the inertial sensor. At least
  // `every` seconds lie between two. Throws std::runtime_error naming the file when it cannot be read or has no
  // position.
  static Track read(const std::filesystem::path& log, double every, bool inertial);
};

// A LineString with a time, a mode and standard deviations for each position, in its properties. Heights are above the
// WGS84 ellipsoid, as RFC 7946 wants them.
void write_geojson(const Track& track, std::ostream& out);
// A line on the map, absolute in height. KML knows heights above the sea only: `geoid_separation` (m, geoid over
// ellipsoid) is taken off, here and in GPX.
void write_kml(const Track& track, double geoid_separation, std::ostream& out);
// A track with a new segment wherever the position was reset.
void write_gpx(const Track& track, double geoid_separation, std::ostream& out);
// One line a pose: time in s, position in the first state's G in m, quaternion x y z w.
void write_tum(const Track& track, std::ostream& out);

}  // namespace orthonav::exporting
