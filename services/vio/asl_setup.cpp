#include "services/vio/asl_setup.h"

#include <fstream>
#include <stdexcept>
#include <string>

#include <fmt/format.h>
#include <yaml-cpp/yaml.h>

namespace orthonav::vio {
namespace {

YAML::Node read_sensor(const std::filesystem::path& file) {
  std::ifstream in(file);
  if (!in) throw std::runtime_error(fmt::format("{}: cannot be read", file.string()));
  // The files of the original dataset begin with a "%YAML:1.0" that is no directive of YAML.
  std::string text, line;
  while (std::getline(in, line)) {
    if (!line.empty() && line[0] != '%') text += line + "\n";
  }
  return YAML::Load(text);
}

Eigen::Matrix4d transform(const YAML::Node& node) {
  Eigen::Matrix4d T;
  for (int k = 0; k < 16; ++k) T(k / 4, k % 4) = node["data"][k].as<double>();
  return T;
}

CameraParameters camera_of(const YAML::Node& node) {
  CameraParameters parameters;
  parameters.width = node["resolution"][0].as<int>();
  parameters.height = node["resolution"][1].as<int>();
  parameters.fx = node["intrinsics"][0].as<double>();
  parameters.fy = node["intrinsics"][1].as<double>();
  parameters.cx = node["intrinsics"][2].as<double>();
  parameters.cy = node["intrinsics"][3].as<double>();
  const auto model = node["distortion_model"].as<std::string>();
  if (model == "equidistant") {
    parameters.model = LensModel::kEquidistant;
  } else if (model != "radial-tangential" && model != "radtan") {
    throw std::runtime_error(fmt::format("unknown distortion_model '{}'", model));
  }
  for (size_t k = 0; k < 4; ++k) parameters.distortion[k] = node["distortion_coefficients"][k].as<double>();
  return parameters;
}

}  // namespace

VioSetup load_asl_setup(const std::filesystem::path& folder, const VioOptions& base) {
  const auto mav = std::filesystem::exists(folder / "mav0") ? folder / "mav0" : folder;
  std::filesystem::path file = mav / "cam0/sensor.yaml";
  try {
    const YAML::Node camera = read_sensor(file);
    VioSetup setup{base, CameraModel(camera_of(camera)), {}};
    const Eigen::Matrix4d T_B_C = transform(camera["T_BS"]);
    const Eigen::Matrix3d R_B_C = T_B_C.topLeftCorner<3, 3>();
    setup.extrinsics.R_B_C = Eigen::Quaterniond(R_B_C).normalized().toRotationMatrix();
    setup.extrinsics.p_B_C = T_B_C.topRightCorner<3, 1>();
    file = mav / "imu0/sensor.yaml";
    const YAML::Node imu = read_sensor(file);
    setup.options.imu = {imu["gyroscope_noise_density"].as<double>(), imu["gyroscope_random_walk"].as<double>(),
                         imu["accelerometer_noise_density"].as<double>(),
                         imu["accelerometer_random_walk"].as<double>()};
    return setup;
  } catch (const std::exception& error) {
    throw std::runtime_error(fmt::format("{}: {}", file.string(), error.what()));
  }
}

}  // namespace orthonav::vio
