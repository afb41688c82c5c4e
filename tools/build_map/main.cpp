// orthonav-build-map: makes a map database (.onmap) of an orthophoto.
#include <chrono>
#include <cstdio>
#include <filesystem>

#include <CLI/CLI.hpp>
#include <fmt/format.h>
#include <unistd.h>

#include "services/map_server/map_builder.h"

int main(int argc, char** argv) {
  using orthonav::map_server::BuildOptions;
  CLI::App app{"Makes a map database (.onmap) of an orthophoto: any raster GDAL reads, in any coordinate system."};
  std::filesystem::path raster;
  std::filesystem::path config;
  std::filesystem::path out;
  std::string dem;
  app.add_option("raster", raster, "the orthophoto")->required()->check(CLI::ExistingFile);
  app.add_option("--out", out, "database to write, FILE.onmap")->required();
  app.add_option("--dem", dem, "elevation model of ellipsoidal ground heights, any raster")->check(CLI::ExistingFile);
  app.add_option("--config", config, "folder with map_server.yaml (default: built-in defaults)")
      ->check(CLI::ExistingDirectory);
  CLI11_PARSE(app, argc, argv);
  try {
    BuildOptions options;
    if (!config.empty()) options = orthonav::map_server::ServerOptions::from_config(config).build;
    if (!dem.empty()) options.dem = dem;
    const bool terminal = isatty(STDERR_FILENO) != 0;
    const auto start = std::chrono::steady_clock::now();
    const auto result = orthonav::map_server::build_map(raster, options, out, [&](double done) {
      if (terminal) fmt::print(stderr, "\r{:3.0f} %", 100 * done);
    });
    if (terminal) fmt::print(stderr, "\r");
    const double seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    const auto& map = result.description;
    fmt::print("{}: {} features at {:.3f} m/px in {} x {} tiles, anchored at {:.7f}, {:.7f}, {:.1f} m\n", out.string(),
               map.num_features, map.metres_per_pixel, map.tile_columns, map.tile_rows, map.anchor.latitude_deg,
               map.anchor.longitude_deg, map.anchor.height);
    fmt::print("left out: {} points without data, {} without texture; heights {}; fingerprint {}; {:.1f} s\n",
               result.skipped_nodata, result.skipped_texture, map.has_surface ? "from the elevation model" : "flat",
               map.fingerprint, seconds);
    return 0;
  } catch (const std::exception& error) {
    std::fprintf(stderr, "orthonav-build-map: %s\n", error.what());
    return 1;
  }
}
