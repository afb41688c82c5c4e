#include <CLI/CLI.hpp>

#include "services/ingest/ingest_service.h"

int main(int argc, char** argv) {
  orthonav::ingest::IngestOptions options;
  return orthonav::service_main(
      argc, argv, "ingest", "Puts sensors on the bus: a recorded flight or a dataset, paced by its time stamps.",
      [&](CLI::App& app) {
        app.add_option("--log", options.log, "LCM log to fly")->check(CLI::ExistingFile);
        app.add_option("--asl", options.asl, "EuRoC/ASL folder to fly")->check(CLI::ExistingDirectory);
        app.add_option("--speed", options.speed, "times real time")->capture_default_str();
        app.add_option("--wait-for", options.wait_for, "services to wait for before the first message")->delimiter(',');
        app.add_flag("--progress", options.progress, "show a progress line");
      },
      [&](orthonav::Node& node, const std::filesystem::path& config) {
        return std::make_unique<orthonav::ingest::IngestService>(node, config, options);
      });
}
