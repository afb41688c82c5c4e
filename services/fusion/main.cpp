#include "services/fusion/fusion_service.h"

int main(int argc, char** argv) {
  return orthonav::service_main(
      argc, argv, "fusion", "Fuses the odometry with fixes on the map: publishes where the aircraft is (NAV_STATE).",
      [](CLI::App&) {},
      [](orthonav::Node& node, const std::filesystem::path& config) {
        return std::make_unique<orthonav::fusion::FusionService>(node, config);
      });
}
