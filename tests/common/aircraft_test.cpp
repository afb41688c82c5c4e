#include "common/camera/aircraft.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "common/camera/camera_model.h"
#include "tests/support/temporary_folder.h"

namespace orthonav {
namespace {

using testing::HasSubstr;

// As kalibr_calibrate_imu_camera writes it.
constexpr const char* kCamchain = R"(cam0:
  T_cam_imu:
  - [0.0, -1.0, 0.0, 0.01]
  - [-1.0, 0.0, 0.0, 0.08]
  - [0.0, 0.0, -1.0, -0.05]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [-0.283, 0.074, 0.0002, 0.00002]
  distortion_model: radtan
  intrinsics: [458.6, 457.3, 367.2, 248.4]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
  timeshift_cam_imu: 0.0123
)";
constexpr const char* kImu = R"(accelerometer_noise_density: 2.5e-3
accelerometer_random_walk: 3.5e-3
gyroscope_noise_density: 1.5e-4
gyroscope_random_walk: 2.5e-5
rostopic: /imu0
update_rate: 400.0
)";
constexpr const char* kAircraft = R"(camera: {width: 10, height: 10, fx: 1, fy: 1, cx: 5, cy: 5}
imu: {gyro_noise: 1.0, gravity: 9.79}
magnetic_declination_deg: 3.4
kalibr: {camchain: camchain-imucam.yaml, imu: imu.yaml}
)";

class Aircraft : public testing::Test {
 protected:
  void write_all(const std::string& camchain = kCamchain) const {
    folder_.write("aircraft.yaml", kAircraft);
    folder_.write("camchain-imucam.yaml", camchain);
    folder_.write("imu.yaml", kImu);
  }
  std::string error() const {
    try {
      load_aircraft(folder_.path());
    } catch (const ConfigError& e) {
      return e.what();
    }
    return "no error";
  }
  static std::string replaced(std::string text, const std::string& what, const std::string& by) {
    const auto at = text.find(what);
    if (at == std::string::npos) throw std::logic_error("nothing to replace");
    return text.replace(at, what.size(), by);
  }
  test::TemporaryFolder folder_;
};

TEST_F(Aircraft, KalibrsCameraStandsInPlaceOfTheTypedOne) {
  write_all();
  ConfigNode aircraft = load_aircraft(folder_.path());
  ConfigNode node = aircraft.child("camera");
  const CameraParameters p = CameraModel::from_config(node).parameters();
  EXPECT_EQ(p.width, 752);
  EXPECT_EQ(p.height, 480);
  EXPECT_EQ(p.fx, 458.6);
  EXPECT_EQ(p.cy, 248.4);
  EXPECT_EQ(p.model, LensModel::kRadtan);
  EXPECT_EQ(p.distortion[0], -0.283);
  double declination = 0;
  aircraft.require("magnetic_declination_deg", declination);
  EXPECT_EQ(declination, 3.4);
}

// x_C = R_C_B x_B + t must be undone by x_B = R_B_C x_C + p_B_C.
TEST_F(Aircraft, TheExtrinsicsAreTheInverseOfKalibrs) {
  write_all();
  ConfigNode aircraft = load_aircraft(folder_.path());
  ConfigNode node = aircraft.child("extrinsics");
  const Extrinsics e = Extrinsics::from_config(node);
  Eigen::Matrix3d R_C_B;
  R_C_B << 0, -1, 0, -1, 0, 0, 0, 0, -1;
  const Eigen::Vector3d x_B(0.3, -0.7, 1.1);
  const Eigen::Vector3d x_C = R_C_B * x_B + Eigen::Vector3d(0.01, 0.08, -0.05);
  EXPECT_LT((e.R_B_C * x_C + e.p_B_C - x_B).norm(), 1e-12);
  EXPECT_EQ(e.time_offset, 0.0123);
}

TEST_F(Aircraft, TheNoiseOfTheImuIsKalibrsAndTheRestStays) {
  write_all();
  ConfigNode aircraft = load_aircraft(folder_.path());
  ConfigNode imu = aircraft.child("imu");
  double gyro_noise = 0, accel_walk = 0, rate = 0, gravity = 0;
  imu.require("gyro_noise", gyro_noise);
  imu.require("accel_walk", accel_walk);
  imu.require("rate_hz", rate);
  imu.require("gravity", gravity);
  EXPECT_EQ(gyro_noise, 1.5e-4);
  EXPECT_EQ(accel_walk, 3.5e-3);
  EXPECT_EQ(rate, 400);
  EXPECT_EQ(gravity, 9.79);
}

TEST_F(Aircraft, TheEquidistantLensIsRead) {
  write_all(replaced(kCamchain, "distortion_model: radtan", "distortion_model: equidistant"));
  ConfigNode aircraft = load_aircraft(folder_.path());
  ConfigNode node = aircraft.child("camera");
  EXPECT_EQ(CameraModel::from_config(node).parameters().model, LensModel::kEquidistant);
}

TEST_F(Aircraft, WhatCannotBeUsedIsAnErrorWithFileAndLine) {
  write_all(replaced(kCamchain, "camera_model: pinhole", "camera_model: omni"));
  EXPECT_THAT(error(), testing::AllOf(HasSubstr("camchain-imucam.yaml:8"), HasSubstr("omni")));
  write_all(replaced(kCamchain, "distortion_model: radtan", "distortion_model: fov"));
  EXPECT_THAT(error(), testing::AllOf(HasSubstr("camchain-imucam.yaml:10"), HasSubstr("fov")));
  write_all(replaced(kCamchain, "[0.0, -1.0, 0.0, 0.01]", "[0.0, -1.5, 0.0, 0.01]"));
  EXPECT_THAT(error(), HasSubstr("rigid"));
  write_all(replaced(kCamchain, "[752, 480]", "[752]"));
  EXPECT_THAT(error(), HasSubstr("2 numbers"));
  write_all(replaced(kCamchain, "cam0:", "cam1:"));
  EXPECT_THAT(error(), HasSubstr("'cam0': is missing"));
  write_all();
  std::filesystem::remove(folder_ / "imu.yaml");
  EXPECT_THAT(error(), testing::AllOf(HasSubstr("imu.yaml"), HasSubstr("no such file")));
}

TEST_F(Aircraft, AMisspeltKeyOfTheKalibrEntryIsAnError) {
  write_all();
  folder_.write("aircraft.yaml", "kalibr: {camchian: camchain-imucam.yaml}\n");
  EXPECT_THAT(error(), HasSubstr("camchian"));
}

}  // namespace
}  // namespace orthonav
