#include <cstdio>

#include <CLI/CLI.hpp>

#include "services/ingest/ingest_service.h"
#include "services/ingest/sensor_options.h"
#include "services/ingest/sensor_service.h"

namespace {

// What the service would do as root, done by root beforehand: no bus is joined.
int prepare(const std::filesystem::path& config) {
  try {
    orthonav::ingest::prepare_sensors(config);
    return 0;
  } catch (const std::exception& error) {
    std::fprintf(stderr, "orthonav-ingest: %s\n", error.what());
    return 1;
  }
}

}  // namespace

int main(int argc, char** argv) {
  orthonav::ingest::IngestOptions options;
  bool sensors = false;
  if (argc == 3 && std::string(argv[1]) == "--prepare-sensors") return prepare(argv[2]);
  return orthonav::service_main(
      argc, argv, "ingest",
      "Puts sensors on the bus: those of this board, or a recorded flight or dataset, paced by its time stamps. "
      "`orthonav-ingest --prepare-sensors CONFIG` only sets up what needs root.",
      [&](CLI::App& app) {
        app.add_flag("--sensors", sensors, "read the sensors of this board, as the folder's ingest.yaml names them");
        app.add_option("--log", options.log, "LCM log to fly")->check(CLI::ExistingFile)->excludes("--sensors");
        app.add_option("--asl", options.asl, "EuRoC/ASL folder to fly")
            ->check(CLI::ExistingDirectory)
            ->excludes("--sensors");
        app.add_option("--speed", options.speed, "times real time")->capture_default_str();
        app.add_option("--wait-for", options.wait_for, "services to wait for before the first message")->delimiter(',');
        app.add_flag("--progress", options.progress, "show a progress line");
      },
      [&](orthonav::Node& node, const std::filesystem::path& config) -> std::unique_ptr<orthonav::Service> {
        if (sensors) return std::make_unique<orthonav::ingest::SensorService>(node, config);
        return std::make_unique<orthonav::ingest::IngestService>(node, config, options);
      });
}
