#include "tools/export/export.h"

#include <algorithm>
#include <cmath>
#include <ctime>
#include <stdexcept>
#include <string>

#include <fmt/format.h>
#include <nlohmann/json.hpp>

#include "common/bus/channels.h"
#include "common/flightlog/flightlog.h"
#include "common/geo/enu_frame.h"

namespace orthonav::exporting {
namespace {

const char* name_of_mode(int8_t mode) {
  switch (mode) {
    case nav_state_t::MAP_AIDED:
      return "map_aided";
    case nav_state_t::COASTING:
      return "coasting";
    case nav_state_t::LOST:
      return "lost";
    case nav_state_t::REACQUIRED:
      return "reacquired";
    default:
      return "unknown";
  }
}

std::string iso_time(int64_t utime) {
  const std::time_t seconds = static_cast<std::time_t>(utime / 1'000'000);
  std::tm utc{};
  gmtime_r(&seconds, &utc);
  return fmt::format("{:04}-{:02}-{:02}T{:02}:{:02}:{:02}.{:03}Z", utc.tm_year + 1900, utc.tm_mon + 1, utc.tm_mday,
                     utc.tm_hour, utc.tm_min, utc.tm_sec, utime / 1000 % 1000);
}

double stddev(const nav_state_t& state, int index) {
  return std::sqrt(state.covariance[7 * index]);
}

}  // namespace

Track Track::read(const std::filesystem::path& log, double every, bool inertial) {
  LogReader reader(log);
  Track track;
  const auto step = static_cast<int64_t>(1e6 * every);
  const int8_t source = inertial ? nav_state_t::INERTIAL : nav_state_t::FRAME;
  while (const auto event = reader.next()) {
    if (event->channel != channel::kNavState) continue;
    const auto state = event->decode<nav_state_t>();
    if (!state || state->source != source) continue;
    if (!std::isfinite(state->latitude_deg) || !std::isfinite(state->longitude_deg)) continue;
    if (!track.states.empty() && state->utime < track.states.back().utime + std::max<int64_t>(1, step)) continue;
    track.states.push_back(*state);
  }
  if (track.states.empty()) throw std::runtime_error(fmt::format("{}: no position in it", log.string()));
  return track;
}

void write_geojson(const Track& track, std::ostream& out) {
  using nlohmann::ordered_json;
  ordered_json coordinates = ordered_json::array(), times = ordered_json::array(), modes = ordered_json::array(),
               horizontal = ordered_json::array(), vertical = ordered_json::array();
  for (const nav_state_t& state : track.states) {
    coordinates.push_back({state.longitude_deg, state.latitude_deg, state.ellipsoidal_height});
    times.push_back(iso_time(state.utime));
    modes.push_back(name_of_mode(state.mode));
    horizontal.push_back(std::hypot(stddev(state, 0), stddev(state, 1)));
    vertical.push_back(stddev(state, 2));
  }
  ordered_json feature;
  feature["type"] = "Feature";
  feature["properties"] = {
      {"time", times}, {"mode", modes}, {"horizontal_stddev_m", horizontal}, {"vertical_stddev_m", vertical}};
  feature["geometry"] = {{"type", "LineString"}, {"coordinates", coordinates}};
  out << ordered_json{{"type", "FeatureCollection"}, {"features", ordered_json::array({feature})}}.dump(1) << "\n";
}

void write_kml(const Track& track, double geoid_separation, std::ostream& out) {
  out << "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n"
         "<kml xmlns=\"http://www.opengis.net/kml/2.2\">\n<Document>\n<name>orthonav</name>\n<Placemark>\n"
         "<name>flight</name>\n"
      << fmt::format("<TimeSpan><begin>{}</begin><end>{}</end></TimeSpan>\n", iso_time(track.states.front().utime),
                     iso_time(track.states.back().utime))
      << "<LineString>\n<altitudeMode>absolute</altitudeMode>\n<coordinates>\n";
  for (const nav_state_t& state : track.states) {
    out << fmt::format("{:.9f},{:.9f},{:.3f}\n", state.longitude_deg, state.latitude_deg,
                       state.ellipsoidal_height - geoid_separation);
  }
  out << "</coordinates>\n</LineString>\n</Placemark>\n</Document>\n</kml>\n";
}

void write_gpx(const Track& track, double geoid_separation, std::ostream& out) {
  out << "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n"
         "<gpx version=\"1.1\" creator=\"orthonav-export\" xmlns=\"http://www.topografix.com/GPX/1/1\">\n"
         "<trk>\n<name>flight</name>\n<trkseg>\n";
  int resets = track.states.front().reset_counter;
  for (const nav_state_t& state : track.states) {
    if (state.reset_counter != resets) out << "</trkseg>\n<trkseg>\n";
    resets = state.reset_counter;
    out << fmt::format("<trkpt lat=\"{:.9f}\" lon=\"{:.9f}\"><ele>{:.3f}</ele><time>{}</time></trkpt>\n",
                       state.latitude_deg, state.longitude_deg, state.ellipsoidal_height - geoid_separation,
                       iso_time(state.utime));
  }
  out << "</trkseg>\n</trk>\n</gpx>\n";
}

void write_tum(const Track& track, std::ostream& out) {
  const nav_state_t& first = track.states.front();
  const EnuFrame frame({first.anchor_latitude_deg, first.anchor_longitude_deg, first.anchor_height});
  for (const nav_state_t& state : track.states) {
    // A later segment may have another anchor.
    const Eigen::Vector3d p = frame.to_enu({state.latitude_deg, state.longitude_deg, state.ellipsoidal_height});
    out << fmt::format("{:.6f} {:.4f} {:.4f} {:.4f} {:.7f} {:.7f} {:.7f} {:.7f}\n",
                       1e-6 * static_cast<double>(state.utime), p.x(), p.y(), p.z(), state.q_G_B[1], state.q_G_B[2],
                       state.q_G_B[3], state.q_G_B[0]);
  }
}

}  // namespace orthonav::exporting
