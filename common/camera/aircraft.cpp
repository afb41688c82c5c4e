#include "common/camera/aircraft.h"

#include <string>
#include <vector>

#include <Eigen/Core>
#include <Eigen/LU>
#include <fmt/format.h>
#include <yaml-cpp/yaml.h>

namespace orthonav {

namespace {

using RowMajor3 = Eigen::Matrix<double, 3, 3, Eigen::RowMajor>;

// One of Kalibr's files. They have keys that are nobody's business here (rostopic, cam_overlaps), so unlike our own
// files they may have keys that are not read.
class KalibrFile {
 public:
  explicit KalibrFile(const std::filesystem::path& file) : file_(file) {
    try {
      top_ = YAML::LoadFile(file.string());
    } catch (const YAML::BadFile&) {
      throw ConfigError(fmt::format("{}: no such file", file.string()));
    } catch (const YAML::Exception& error) {
      throw ConfigError(fmt::format("{}:{}: {}", file.string(), error.mark.line + 1, error.msg));
    }
    if (!top_.IsMap()) throw ConfigError(fmt::format("{}: not a file of Kalibr", file.string()));
  }

  YAML::Node top() const { return top_; }

  [[noreturn]] void fail(const YAML::Node& at, const std::string& key, const std::string& what) const {
    throw ConfigError(fmt::format("{}:{}: key '{}': {}", file_.string(), at.Mark().line + 1, key, what));
  }

  template <class T>
  T require(const YAML::Node& map, const std::string& key, const char* type) const {
    const YAML::Node value = map[key];
    if (!value.IsDefined()) fail(map, key, "is missing");
    try {
      return value.as<T>();
    } catch (const YAML::Exception&) {
      fail(value, key, fmt::format("must be {}", type));
    }
  }

  std::vector<double> require_list(const YAML::Node& map, const std::string& key, size_t size) const {
    auto list = require<std::vector<double>>(map, key, "a list of numbers");
    if (list.size() != size) fail(map[key], key, fmt::format("must have {} numbers", size));
    return list;
  }

 private:
  std::filesystem::path file_;
  YAML::Node top_;
};

YAML::Node camera_of(const KalibrFile& file, const YAML::Node& cam) {
  const auto model = file.require<std::string>(cam, "camera_model", "a text");
  if (model != "pinhole") file.fail(cam["camera_model"], "camera_model", "must be pinhole, not '" + model + "'");
  const auto lens = file.require<std::string>(cam, "distortion_model", "a text");
  if (lens != "radtan" && lens != "equidistant") {
    file.fail(cam["distortion_model"], "distortion_model", "must be radtan or equidistant, not '" + lens + "'");
  }
  const auto size = file.require_list(cam, "resolution", 2);
  for (const double side : size) {
    if (!(side >= 1 && side <= 1e5))
      file.fail(cam["resolution"], "resolution", "must be a width and a height in pixels");
  }
  const auto intrinsics = file.require_list(cam, "intrinsics", 4);
  YAML::Node camera;
  camera["width"] = static_cast<int>(size[0]);
  camera["height"] = static_cast<int>(size[1]);
  const char* names[] = {"fx", "fy", "cx", "cy"};
  for (size_t i = 0; i < 4; ++i) camera[names[i]] = intrinsics[i];
  camera["model"] = lens;
  camera["distortion"] = file.require_list(cam, "distortion_coeffs", 4);
  return camera;
}

// Kalibr's T_cam_imu takes IMU coordinates to the camera; ours is the inverse.
YAML::Node extrinsics_of(const KalibrFile& file, const YAML::Node& cam) {
  const auto rows = file.require<std::vector<std::vector<double>>>(cam, "T_cam_imu", "4 rows of 4 numbers");
  Eigen::Matrix4d T_C_B;
  if (rows.size() != 4) file.fail(cam["T_cam_imu"], "T_cam_imu", "must be 4 rows of 4 numbers");
  for (size_t r = 0; r < 4; ++r) {
    if (rows[r].size() != 4) file.fail(cam["T_cam_imu"], "T_cam_imu", "must be 4 rows of 4 numbers");
    for (size_t c = 0; c < 4; ++c) T_C_B(static_cast<int>(r), static_cast<int>(c)) = rows[r][c];
  }
  const Eigen::Matrix3d R_C_B = T_C_B.topLeftCorner<3, 3>();
  if (!((R_C_B * R_C_B.transpose() - Eigen::Matrix3d::Identity()).norm() < 1e-3) || R_C_B.determinant() < 0 ||
      !T_C_B.row(3).isApprox(Eigen::RowVector4d(0, 0, 0, 1))) {
    file.fail(cam["T_cam_imu"], "T_cam_imu", "is no rigid transformation");
  }
  const RowMajor3 R_B_C = R_C_B.transpose();
  const Eigen::Vector3d p_B_C = -(R_B_C * T_C_B.topRightCorner<3, 1>());
  YAML::Node extrinsics;
  extrinsics["p_B_C"] = std::vector<double>(p_B_C.data(), p_B_C.data() + 3);
  extrinsics["R_B_C"] = std::vector<double>(R_B_C.data(), R_B_C.data() + 9);
  extrinsics["time_offset"] =
      cam["timeshift_cam_imu"].IsDefined() ? file.require<double>(cam, "timeshift_cam_imu", "a number") : 0.0;
  return extrinsics;
}

YAML::Node imu_of(const KalibrFile& file) {
  // imu.yaml has its keys at the top; kalibr's own imu-<bag>.yaml result has them under imu0.
  const YAML::Node top = file.top();
  const YAML::Node source = top["imu0"].IsDefined() ? top["imu0"] : top;
  YAML::Node imu;
  imu["gyro_noise"] = file.require<double>(source, "gyroscope_noise_density", "a number");
  imu["gyro_walk"] = file.require<double>(source, "gyroscope_random_walk", "a number");
  imu["accel_noise"] = file.require<double>(source, "accelerometer_noise_density", "a number");
  imu["accel_walk"] = file.require<double>(source, "accelerometer_random_walk", "a number");
  imu["rate_hz"] = file.require<double>(source, "update_rate", "a number");
  return imu;
}

}  // namespace

ConfigNode load_aircraft(const std::filesystem::path& folder) {
  ConfigNode aircraft = ConfigNode::load(folder / "aircraft.yaml");
  if (!aircraft.has("kalibr")) return aircraft;
  ConfigNode kalibr = aircraft.child("kalibr");
  std::filesystem::path camchain, imu;
  std::string camera = "cam0";
  kalibr.read_path("camchain", camchain);
  kalibr.read_path("imu", imu);
  kalibr.read("camera", camera);
  kalibr.finish();
  if (camchain.empty() && imu.empty()) aircraft.fail("kalibr", "names neither `camchain` nor `imu`");
  if (!camchain.empty()) {
    const KalibrFile file(camchain);
    const YAML::Node chain = file.top();
    const YAML::Node cam = chain[camera];
    if (!cam.IsDefined() || !cam.IsMap()) file.fail(chain, camera, "is missing");
    YAML::Node layer;
    layer["camera"] = camera_of(file, cam);
    layer["extrinsics"] = extrinsics_of(file, cam);
    aircraft.overlay(layer, camchain);
  }
  if (!imu.empty()) {
    YAML::Node layer;
    layer["imu"] = imu_of(KalibrFile(imu));
    aircraft.overlay(layer, imu);
  }
  return aircraft;
}

}  // namespace orthonav
