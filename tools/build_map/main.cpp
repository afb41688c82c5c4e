// orthonav-build-map: makes a map database (.onmap) of an orthophoto.
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <filesystem>
#include <string>

#include <CLI/CLI.hpp>
#include <fmt/format.h>
#include <unistd.h>

#include "services/map_server/map_builder.h"

namespace {

using namespace orthonav::map_server;

// A bar with the time left on a terminal, nothing elsewhere.
class ProgressBar {
 public:
  ~ProgressBar() {
    if (terminal_) fmt::print(stderr, "\r\033[K");
  }
  void show(const BuildProgress& progress) {
    if (!terminal_) return;
    constexpr int kWidth = 40;
    const double fraction = static_cast<double>(progress.done) / static_cast<double>(progress.total);
    const auto full = static_cast<size_t>(kWidth * fraction);
    const double seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start_).count();
    const auto built = static_cast<double>(progress.done - progress.resumed);
    const std::string left =
        built > 0 ? fmt::format("{:.0f} s left", seconds / built * static_cast<double>(progress.total - progress.done))
                  : std::string();
    fmt::print(stderr, "\r\033[K[{}{}] {:5.1f} % of {} blocks  {}", std::string(full, '#'),
               std::string(kWidth - full, ' '), 100 * fraction, progress.total, left);
  }

 private:
  bool terminal_ = isatty(STDERR_FILENO) != 0;
  std::chrono::steady_clock::time_point start_ = std::chrono::steady_clock::now();
};

void describe(const std::filesystem::path& file, const std::vector<MapDescription>& levels) {
  const auto& anchor = levels.front().anchor;
  fmt::print("{}: {} {}, anchored at {:.7f}, {:.7f}, {:.1f} m, heights {}\n", file.string(),
             name_of(levels.front().features), levels.front().fingerprint, anchor.latitude_deg, anchor.longitude_deg,
             anchor.height, levels.front().has_surface ? "from the elevation model" : "flat");
  for (const MapDescription& level : levels) {
    fmt::print(
        "{:.3f} m/px: {} features in {} x {} tiles of {} m; left out {} points without data, {} without texture\n",
        level.metres_per_pixel, level.num_features, level.tile_columns, level.tile_rows, level.tile_size,
        level.num_without_data, level.num_without_texture);
  }
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{
      "Makes a map database (.onmap) of an orthophoto: any raster or mosaic (VRT) GDAL reads, in any coordinate "
      "system. A build that was broken off goes on where it stopped when it is started again."};
  std::filesystem::path raster;
  std::filesystem::path config;
  std::filesystem::path out;
  std::string dem;
  bool verify = false;
  app.add_option("raster", raster, "the orthophoto, or the database to --verify")->required()->check(CLI::ExistingFile);
  auto* out_option = app.add_option("--out", out, "database to write, FILE.onmap");
  app.add_option("--dem", dem, "elevation model of ellipsoidal ground heights, any raster")->check(CLI::ExistingFile);
  app.add_option("--config", config, "folder with map_server.yaml (default: built-in defaults)")
      ->check(CLI::ExistingDirectory);
  app.add_flag("--verify", verify, "read every tile of a database and compare its checksum")->excludes(out_option);
  CLI11_PARSE(app, argc, argv);
  try {
    if (verify) {
      const MapDatabase database(raster);
      database.verify();
      describe(raster, database.levels());
      return 0;
    }
    if (out.empty()) throw std::runtime_error("--out is missing: the database to write");
    BuildOptions options;
    if (!config.empty()) options = ServerOptions::from_config(config).build;
    if (!dem.empty()) options.dem = dem;
    const auto start = std::chrono::steady_clock::now();
    std::vector<MapDescription> levels;
    {
      ProgressBar bar;
      levels = build_map(raster, options, out, [&](const BuildProgress& progress) { bar.show(progress); });
    }
    describe(out, levels);
    fmt::print("{:.1f} s\n", std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count());
    return 0;
  } catch (const std::exception& error) {
    std::fprintf(stderr, "orthonav-build-map: %s\n", error.what());
    return 1;
  }
}
