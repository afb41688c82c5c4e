#include <cstdio>
#include <fstream>
#include <optional>

#include <CLI/CLI.hpp>
#include <fmt/format.h>

#include "tools/evaluate/flight_record.h"
#include "tools/evaluate/metrics.h"
#include "tools/evaluate/pictures.h"
#include "tools/evaluate/report_html.h"
#include "tools/evaluate/report_json.h"
#include "tools/evaluate/tum.h"

namespace {

namespace fs = std::filesystem;

void write_file(const fs::path& file, const std::string& text) {
  std::ofstream out(file, std::ios::binary);
  out << text;
  out.close();
  if (!out) throw std::runtime_error(fmt::format("{}: cannot write", file.string()));
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{
      "Measures a recorded flight: accuracy, uncertainty, times and losses, as a table, JSON and an HTML report."};
  fs::path log, json, html, map, tum;
  app.add_option("log", log, "LCM log with what the services said")->required()->check(CLI::ExistingFile);
  app.add_option("--json", json, "write the figures here");
  app.add_option("--html", html, "write the report with its pictures here");
  app.add_option("--map", map, "the map as a raster, for the pictures")->check(CLI::ExistingFile);
  app.add_option("--tum", tum, "write truth.tum, vio.tum and fusion.tum into this folder");
  CLI11_PARSE(app, argc, argv);
  try {
    using namespace orthonav::evaluate;
    const FlightRecord record = FlightRecord::read(log);
    const Metrics metrics = evaluate(record);
    if (!json.empty()) write_file(json, to_json(record, metrics).dump(2) + "\n");
    if (!tum.empty()) write_tum(record, tum);
    if (!html.empty()) {
      std::optional<MapPicture> picture;
      if (!map.empty()) picture.emplace(map);
      const MapPicture* shown = picture ? &*picture : nullptr;
      const auto matches = draw_matches(log, record, metrics.registration, shown);
      write_file(html, to_html(log.filename().string(), record, metrics, draw_tracks(record, metrics, shown), matches));
    }
    std::fputs(to_table(metrics).c_str(), stdout);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "orthonav-evaluate: %s\n", error.what());
    return 1;
  }
  return 0;
}
