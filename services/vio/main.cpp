// orthonav-vio: the visual-inertial odometry as a process.
#include <opencv2/core/utility.hpp>

#include "services/vio/vio_service.h"

int main(int argc, char** argv) {
  cv::setNumThreads(1);  // one core is what the odometry may have
  return orthonav::service_main(
      argc, argv, "vio", "Visual-inertial odometry: IMU and CAMERA to VIO_STATE and VIO_KEYFRAME", [](CLI::App&) {},
      [](orthonav::Node& node, const std::filesystem::path& config) {
        return std::make_unique<orthonav::vio::VioService>(node, config);
      });
}
