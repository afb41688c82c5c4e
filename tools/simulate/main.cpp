// orthonav-simulate: makes a flight's log and the map to navigate it by.
#include <chrono>
#include <cstdio>
#include <exception>
#include <string>
#include <thread>

#include <CLI/CLI.hpp>
#include <fmt/format.h>
#include <unistd.h>

#include "tools/simulate/flight_recorder.h"

namespace {

using orthonav::simulate::RecordingOptions;
using orthonav::simulate::RecordingSummary;
using orthonav::simulate::Scenario;

struct Arguments {
  std::filesystem::path scenario, out, asl;
  uint64_t seed = 1;
  std::string difference = "season";
  bool map_only = false;
  double duration = 0;
  int threads = static_cast<int>(std::max(1U, std::thread::hardware_concurrency()));
};

void print_progress(double flown, double total, std::chrono::steady_clock::time_point start) {
  static auto last = start - std::chrono::hours(1);
  static const bool terminal = isatty(STDERR_FILENO) == 1;
  const auto now = std::chrono::steady_clock::now();
  if (now - last < (terminal ? std::chrono::milliseconds(500) : std::chrono::seconds(20))) return;
  last = now;
  const double elapsed = std::chrono::duration<double>(now - start).count();
  fmt::print(stderr, "{}flight: {:5.1f} of {:.1f} s rendered, {:.0f} s left   {}", terminal ? "\r" : "", flown, total,
             elapsed * (total / std::max(flown, 0.1) - 1), terminal ? "" : "\n");
}

int simulate(const Arguments& arguments) {
  Scenario scenario = Scenario::load(arguments.scenario);
  const auto map_file = std::filesystem::path(arguments.out).replace_extension(".map.tif");
  const auto start = std::chrono::steady_clock::now();
  fmt::print(stderr, "world: seed {}, difference {}\n", arguments.seed, arguments.difference);
  const orthonav::simulate::World world =
      orthonav::simulate::make_world(scenario.world, arguments.seed, arguments.difference, map_file);
  fmt::print("map:    {} ({:.0f} x {:.0f} m)\n", map_file.string(), world.map_east_max - world.map_east_min,
             world.map_north_max - world.map_north_min);
  if (arguments.map_only) return 0;

  RecordingOptions options{.log = arguments.out,
                           .asl_folder = arguments.asl,
                           .seconds = arguments.duration > 0 ? arguments.duration : scenario.record_s,
                           .threads = arguments.threads,
                           .progress = {}};
  const auto render_start = std::chrono::steady_clock::now();
  options.progress = [&](double flown, double total) { print_progress(flown, total, render_start); };
  const RecordingSummary summary = record_flight(scenario, world, arguments.seed, options);
  const double elapsed = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  if (isatty(STDERR_FILENO) == 1) fmt::print(stderr, "\n");
  fmt::print("flight: {:.1f} s, {:.2f} km, mean tilt {:.2f} deg; {:.1f} s of it recorded\n", summary.flight_seconds,
             1e-3 * summary.path_length, summary.mean_tilt * 57.29577951308232, summary.seconds);
  fmt::print("log:    {} ({:.0f} MB): {} images, {} IMU samples; {:.0f} s to make\n", arguments.out.string(),
             1e-6 * static_cast<double>(std::filesystem::file_size(arguments.out)), summary.images, summary.imu_samples,
             elapsed);
  if (summary.outside > 0) {
    fmt::print("warning: up to {:.2g} % of an image looks beyond the world; enlarge its margin or border_margin_m\n",
               100 * summary.outside);
  }
  return 0;
}

int run(int argc, char** argv) {
  CLI::App app("Simulates a flight: an LCM log of its sensors and the truth, and the map (GeoTIFF) beside it");
  Arguments arguments;
  app.add_option("--scenario", arguments.scenario, "folder with simulate.yaml and aircraft.yaml, e.g. config/rural")
      ->required()
      ->check(CLI::ExistingDirectory);
  app.add_option("--seed", arguments.seed, "what is drawn at random: world, path, weather, noise")
      ->capture_default_str();
  app.add_option("--out", arguments.out, "log to write; the map goes beside it as NAME.map.tif")->required();
  app.add_option("--difference", arguments.difference, "what lies between the map and the flight: season or years")
      ->capture_default_str();
  app.add_flag("--map-only", arguments.map_only, "write the map, no flight");
  app.add_option("--asl", arguments.asl, "also write the flight as an EuRoC/ASL folder here");
  app.add_option("--duration", arguments.duration, "s of the flight to record; default: as the scenario says")
      ->check(CLI::PositiveNumber);
  app.add_option("--threads", arguments.threads, "threads that render; the result does not depend on it")
      ->check(CLI::Range(1, 256))
      ->capture_default_str();
  CLI11_PARSE(app, argc, argv);
  return simulate(arguments);
}

}  // namespace

int main(int argc, char** argv) {
  try {
    return run(argc, argv);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "orthonav-simulate: %s\n", error.what());
    return 1;
  }
}
