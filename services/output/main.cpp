#include "services/output/output_service.h"

int main(int argc, char** argv) {
  return orthonav::service_main(
      argc, argv, "output", "Hands the position on to programs that speak no LCM: NMEA 0183 over UDP or a serial line.",
      [](CLI::App&) {},
      [](orthonav::Node& node, const std::filesystem::path& config) {
        return std::make_unique<orthonav::output::OutputService>(node, config);
      });
}
