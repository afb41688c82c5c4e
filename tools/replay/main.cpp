#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>
#include <spdlog/sinks/stdout_color_sinks.h>
#include <spdlog/spdlog.h>

#include "common/bus/node.h"
#include "tools/replay/replay.h"

int main(int argc, char** argv) {
  CLI::App app{"Flies a log through all services in one process, as fast as the machine allows, repeatably."};
  orthonav::replay::ReplayOptions options;
  bool timings = false;
  int loops = 0;
  app.add_option("--config", options.config,
                 "folder of the aircraft or scenario, e.g. config/rural (with --asl: may be left out, for the odometry "
                 "alone with its default parameters)")
      ->check(CLI::ExistingDirectory);
  auto* log = app.add_option("--log", options.log, "LCM log to fly")->check(CLI::ExistingFile);
  auto* asl = app.add_option("--asl", options.asl, "EuRoC/ASL folder to fly, with the calibration in it")
                  ->check(CLI::ExistingDirectory);
  log->excludes(asl);
  app.add_option("--map", options.map, "map: a raster or a database of orthonav-build-map (default: odometry alone)")
      ->check(CLI::ExistingFile);
  app.add_option("--out", options.out, "LCM log to write: the sensors and everything the services said");
  app.add_option("--trajectory", options.trajectory,
                 "the odometry's trajectory to write, in TUM's format (default with --asl: vio.tum)");
  app.add_option("--times", options.times,
                 "table to write of each image's processing time (default with --asl: vio-times.csv)");
  std::vector<std::string> restarts;
  app.add_option("--restart", restarts,
                 "SERVICE@S: kill it after S seconds of flight and start it again after 0.5 s; may be given again")
      ->delimiter(',');
  app.add_option("--memory", options.memory,
                 "folder where vio and fusion keep what they go on with after a restart (default: none)");
  app.add_option("--loops", loops,
                 "fly the source so many times in a row with the same services, and print what each cost; --out holds "
                 "the last")
      ->check(CLI::PositiveNumber);
  app.add_flag("--timings", timings, "fill in the processing times, which makes the output differ from run to run");
  CLI11_PARSE(app, argc, argv);
  if (!options.asl.empty()) {
    if (options.trajectory.empty()) options.trajectory = "vio.tum";
    if (options.times.empty()) options.times = "vio-times.csv";
  } else if (options.log.empty() || options.config.empty() || options.out.empty()) {
    std::fprintf(stderr, "orthonav-replay: give --asl, or --log with --config and --out\n");
    return 2;
  }
  for (const std::string& text : restarts) {
    const auto at = text.find('@');
    char* end = nullptr;
    const double seconds = at == std::string::npos ? -1 : std::strtod(text.c_str() + at + 1, &end);
    if (!(seconds >= 0) || *end != '\0') {
      std::fprintf(stderr, "orthonav-replay: --restart %s: give SERVICE@SECONDS\n", text.c_str());
      return 2;
    }
    options.restarts.push_back({.service = text.substr(0, at), .at = seconds});
  }
  if (loops > 0) {
    options.loops = loops;
    std::printf("%8s %14s %12s %10s %9s\n", "hours", "cpu ms/image", "resident MB", "map-aided", "sessions");
    options.landed = [](const orthonav::replay::LoopSummary& loop) {
      std::fprintf(stderr, "\r");
      std::printf("%8.2f %14.1f %12.1f %8.1f %% %9d\n", loop.hours, loop.cpu_ms, loop.resident_mb, loop.aided_percent,
                  loop.sessions);
      std::fflush(stdout);
    };
  }
  timings = timings || !options.times.empty();
  spdlog::set_default_logger(spdlog::stderr_color_mt("replay"));
  orthonav::Stopwatch::enable_in_replay(timings);
  options.progress = [](double fraction) { std::fprintf(stderr, "\r  replaying: %3.0f %%", 100 * fraction); };
  try {
    const auto start = std::chrono::steady_clock::now();
    const auto summary = orthonav::replay::replay(options);
    const double elapsed = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    std::fprintf(stderr, "\r");
    std::printf("%.1f s of flight replayed in %.1f s; %lld messages", summary.flight_seconds, elapsed,
                static_cast<long long>(summary.messages));
    for (const auto& file : {options.out, options.trajectory, options.times}) {
      if (!file.empty()) std::printf(", %s", file.c_str());
    }
    std::printf("\n");
  } catch (const std::exception& error) {
    std::fprintf(stderr, "orthonav-replay: %s\n", error.what());
    return 1;
  }
  return 0;
}
