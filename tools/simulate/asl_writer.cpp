#include "tools/simulate/asl_writer.h"

#include <stdexcept>

#include <fmt/format.h>
#include <fmt/ostream.h>
#include <fmt/ranges.h>
#include <opencv2/imgcodecs.hpp>

namespace orthonav::simulate {
namespace {

constexpr int64_t kNanoPerMicro = 1000;

std::ofstream create(const std::filesystem::path& file) {
  std::filesystem::create_directories(file.parent_path());
  std::ofstream out(file, std::ios::binary);
  if (!out) throw std::runtime_error(fmt::format("{}: cannot be created", file.string()));
  return out;
}

void check(std::ofstream& out, const char* what) {
  out.flush();
  if (!out) throw std::runtime_error(fmt::format("{}: writing failed (disk full?)", what));
}

// A 4 x 4 matrix as the sensor.yaml files of the format have it.
std::string transform_yaml(const Eigen::Matrix3d& R, const Eigen::Vector3d& p) {
  std::string rows;
  for (int i = 0; i < 3; ++i) {
    rows += fmt::format("{:.12g}, {:.12g}, {:.12g}, {:.12g},\n         ", R(i, 0), R(i, 1), R(i, 2), p[i]);
  }
  return fmt::format("T_BS:\n  cols: 4\n  rows: 4\n  data: [{}0.0, 0.0, 0.0, 1.0]\n", rows);
}

}  // namespace

AslWriter::AslWriter(const std::filesystem::path& folder, const Scenario& scenario)
    : root_(folder / "mav0"),
      imu_(create(root_ / "imu0" / "data.csv")),
      images_(create(root_ / "cam0" / "data.csv")),
      truth_(create(root_ / "state_groundtruth_estimate0" / "data.csv")) {
  std::filesystem::create_directories(root_ / "cam0" / "data");
  create(root_ / "body.yaml") << "%YAML:1.0\ncomment: orthonav-simulate\n";

  const CameraParameters& camera = scenario.camera.parameters();
  std::ofstream cam = create(root_ / "cam0" / "sensor.yaml");
  cam << "%YAML:1.0\n# General sensor definitions.\nsensor_type: camera\ncomment: simulated\n\n"
      << "# Sensor extrinsics wrt. the body-frame.\n"
      << transform_yaml(scenario.extrinsics.R_B_C, scenario.extrinsics.p_B_C)
      << fmt::format("\n# Camera specific definitions.\nrate_hz: {:g}\nresolution: [{}, {}]\ncamera_model: pinhole\n",
                     scenario.sensors.camera.rate_hz, camera.width, camera.height)
      << fmt::format("intrinsics: [{}, {}, {}, {}] #fu, fv, cu, cv\n", camera.fx, camera.fy, camera.cx, camera.cy)
      << fmt::format("distortion_model: {}\ndistortion_coefficients: [{}]\n",
                     camera.model == LensModel::kRadtan ? "radial-tangential" : "equidistant",
                     fmt::join(camera.distortion, ", "));
  check(cam, "cam0/sensor.yaml");

  const ImuCalibration& imu = scenario.imu;
  std::ofstream imu_yaml = create(root_ / "imu0" / "sensor.yaml");
  imu_yaml << "%YAML:1.0\n# General sensor definitions.\nsensor_type: imu\ncomment: simulated\n\n"
           << "# Sensor extrinsics wrt. the body-frame.\n"
           << transform_yaml(Eigen::Matrix3d::Identity(), Eigen::Vector3d::Zero())
           << fmt::format("rate_hz: {:g}\n\n# inertial sensor noise model parameters (static)\n", imu.rate_hz)
           << fmt::format("gyroscope_noise_density: {:.4e}     # [ rad / s / sqrt(Hz) ]\n", imu.gyro_noise)
           << fmt::format("gyroscope_random_walk: {:.4e}       # [ rad / s^2 / sqrt(Hz) ]\n", imu.gyro_walk)
           << fmt::format("accelerometer_noise_density: {:.4e} # [ m / s^2 / sqrt(Hz) ]\n", imu.accel_noise)
           << fmt::format("accelerometer_random_walk: {:.4e}   # [ m / s^3 / sqrt(Hz) ]\n", imu.accel_walk);
  check(imu_yaml, "imu0/sensor.yaml");

  std::ofstream truth_yaml = create(root_ / "state_groundtruth_estimate0" / "sensor.yaml");
  truth_yaml << "%YAML:1.0\n# General sensor definitions.\nsensor_type: visual-inertial\ncomment: simulated, exact\n\n"
             << transform_yaml(Eigen::Matrix3d::Identity(), Eigen::Vector3d::Zero());
  check(truth_yaml, "state_groundtruth_estimate0/sensor.yaml");

  imu_ << "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
          "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n";
  images_ << "#timestamp [ns],filename\n";
  truth_ << "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
            "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], "
            "b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]\n";
}

void AslWriter::write_imu(const imu_t& imu) {
  fmt::print(imu_, "{},{:.12g},{:.12g},{:.12g},{:.12g},{:.12g},{:.12g}\n", imu.utime * kNanoPerMicro,
             imu.angular_rate[0], imu.angular_rate[1], imu.angular_rate[2], imu.specific_force[0],
             imu.specific_force[1], imu.specific_force[2]);
}

void AslWriter::write_image(const image_t& image) {
  const bool jpeg = image.pixelformat == image_t::PIXEL_FORMAT_MJPEG;
  const std::string name = fmt::format("{}.{}", image.utime * kNanoPerMicro, jpeg ? "jpg" : "png");
  fmt::print(images_, "{},{}\n", image.utime * kNanoPerMicro, name);
  std::vector<uint8_t> bytes = image.data;
  if (!jpeg) cv::imencode(".png", cv::Mat(image.height, image.width, CV_8U, bytes.data()).clone(), bytes);
  std::ofstream file = create(root_ / "cam0" / "data" / name);
  file.write(reinterpret_cast<const char*>(bytes.data()), static_cast<std::streamsize>(bytes.size()));
  check(file, name.c_str());
}

void AslWriter::write_truth(const truth_t& truth, const EnuFrame& frame) {
  const Eigen::Vector3d p = frame.to_enu({truth.latitude_deg, truth.longitude_deg, truth.ellipsoidal_height});
  const Eigen::Matrix3d R_G_local = frame.R_local_G(p).transpose();
  const double* w = truth.q_ENU_B;
  const Eigen::Quaterniond q(R_G_local * Eigen::Quaterniond(w[0], w[1], w[2], w[3]).toRotationMatrix());
  const Eigen::Vector3d v = R_G_local * Eigen::Map<const Eigen::Vector3d>(truth.velocity_enu);
  fmt::print(truth_, "{},{:.6f},{:.6f},{:.6f},{:.9f},{:.9f},{:.9f},{:.9f},{:.6f},{:.6f},{:.6f},",
             truth.utime * kNanoPerMicro, p.x(), p.y(), p.z(), q.w(), q.x(), q.y(), q.z(), v.x(), v.y(), v.z());
  fmt::print(truth_, "{:.8f},{:.8f},{:.8f},{:.8f},{:.8f},{:.8f}\n", truth.gyro_bias[0], truth.gyro_bias[1],
             truth.gyro_bias[2], truth.accel_bias[0], truth.accel_bias[1], truth.accel_bias[2]);
}

void AslWriter::finish() {
  check(imu_, "imu0/data.csv");
  check(images_, "cam0/data.csv");
  check(truth_, "state_groundtruth_estimate0/data.csv");
}

}  // namespace orthonav::simulate
