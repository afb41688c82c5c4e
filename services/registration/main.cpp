#include "services/registration/registration_service.h"

int main(int argc, char** argv) {
  return orthonav::service_main(
      argc, argv, "registration", "Registers keyframes of the odometry to the map.", [](CLI::App&) {},
      [](orthonav::Node& node, const std::filesystem::path& config) {
        return std::make_unique<orthonav::registration::RegistrationService>(node, config);
      });
}
