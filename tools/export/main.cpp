#include <cstdio>
#include <fstream>
#include <functional>
#include <stdexcept>

#include <CLI/CLI.hpp>

#include "tools/export/export.h"

int main(int argc, char** argv) {
  using namespace orthonav::exporting;
  CLI::App app{"Writes the positions of a recorded flight for other programs."};
  std::filesystem::path log, geojson, kml, gpx, tum;
  double every = 0.0, geoid_separation = 0.0;
  bool inertial = false;
  app.add_option("log", log, "LCM log with NAV_STATE")->required()->check(CLI::ExistingFile);
  app.add_option("--geojson", geojson, "GeoJSON file to write: heights above the ellipsoid, time, mode and accuracy");
  app.add_option("--kml", kml, "KML file to write");
  app.add_option("--gpx", gpx, "GPX file to write");
  app.add_option("--tum", tum, "trajectory to write in the TUM format");
  app.add_option("--every", every, "least time between two positions, s (default: all)")->check(CLI::NonNegativeNumber);
  app.add_option("--geoid-separation", geoid_separation,
                 "m, of the geoid over the WGS84 ellipsoid there: KML and GPX have heights above the sea (default 0)");
  app.add_flag("--inertial", inertial, "the positions at the inertial sensor's rate instead of the images'");
  CLI11_PARSE(app, argc, argv);
  try {
    const Track track = Track::read(log, every, inertial);
    const auto write = [](const std::filesystem::path& file, const std::function<void(std::ostream&)>& content) {
      if (file.empty()) return;
      std::ofstream out(file);
      content(out);
      out.close();
      if (!out) throw std::runtime_error(file.string() + ": cannot be written");
    };
    write(geojson, [&](std::ostream& out) { write_geojson(track, out); });
    write(kml, [&](std::ostream& out) { write_kml(track, geoid_separation, out); });
    write(gpx, [&](std::ostream& out) { write_gpx(track, geoid_separation, out); });
    write(tum, [&](std::ostream& out) { write_tum(track, out); });
    std::printf("%zu positions\n", track.states.size());
  } catch (const std::exception& error) {
    std::fprintf(stderr, "orthonav-export: %s\n", error.what());
    return 1;
  }
  return 0;
}
