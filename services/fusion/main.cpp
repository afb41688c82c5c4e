#include <CLI/CLI.hpp>

#include "services/fusion/fusion_service.h"

int main(int argc, char** argv) {
  std::filesystem::path memory;
  return orthonav::service_main(
      argc, argv, "fusion", "Fuses the odometry with fixes on the map: publishes where the aircraft is (NAV_STATE).",
      [&](CLI::App& app) {
        app.add_option("--memory", memory,
                       "file to keep what a killed fusion goes on with, on a file system in memory (default: none)");
      },
      [&](orthonav::Node& node, const std::filesystem::path& config) {
        return std::make_unique<orthonav::fusion::FusionService>(node, config, memory);
      });
}
