// orthonav-vio: the visual-inertial odometry as a process.
#include <CLI/CLI.hpp>
#include <opencv2/core/utility.hpp>

#include "services/vio/vio_service.h"

int main(int argc, char** argv) {
  cv::setNumThreads(1);  // one core is what the odometry may have
  std::filesystem::path memory;
  return orthonav::service_main(
      argc, argv, "vio", "Visual-inertial odometry: IMU and CAMERA to VIO_STATE, VIO_KEYFRAME and KEYFRAME_IMAGE",
      [&](CLI::App& app) {
        app.add_option("--memory", memory,
                       "file to keep what a killed odometry goes on with, on a file system in memory (default: none)");
      },
      [&](orthonav::Node& node, const std::filesystem::path& config) {
        return std::make_unique<orthonav::vio::VioService>(node, config, memory);
      });
}
