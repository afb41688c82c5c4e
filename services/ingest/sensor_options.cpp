#include "services/ingest/sensor_options.h"

#include <algorithm>

#include <Eigen/Core>
#include <Eigen/LU>

#include "common/bus/channels.h"
#include "common/config/config.h"

namespace orthonav::ingest {

namespace {

void read_camera(ConfigNode node, VideoOptions& options) {
  node.read("source", options.source);
  std::string stamps = "auto";
  node.read("stamps", stamps);
  if (stamps == "source") {
    options.stamps = VideoOptions::Stamps::kSource;
  } else if (stamps == "arrival") {
    options.stamps = VideoOptions::Stamps::kArrival;
  } else if (stamps != "auto") {
    node.fail("stamps", "must be auto, source or arrival");
  }
  node.read("width", options.width, 0, 20000);
  node.read("height", options.height, 0, 20000);
  node.read("rate_hz", options.rate_hz, 0, 1000);
  node.read("delay_ms", options.delay_ms, -1000, 1000);
  node.read("jpeg_quality", options.jpeg_quality, 0, 100);
  node.finish();
}

void read_iio(ConfigNode node, IioOptions::Kind kind, IioOptions& options) {
  options.kind = kind;
  node.read("device", options.device);
  node.read_path("sysfs", options.sysfs);
  node.read_path("dev", options.dev);
  node.read("rate_hz", options.rate_hz, 0, 100000);
  node.read("buffer_length", options.buffer_length, 2, 65536);
  std::vector<double> rotation(options.R_B_S.begin(), options.R_B_S.end());
  node.read("R_B_S", rotation);
  if (rotation.size() != 9) node.fail("R_B_S", "must be 9 numbers, row by row");
  const Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>> matrix(rotation.data());
  if (!(matrix * matrix.transpose()).isIdentity(1e-3) || matrix.determinant() < 0)
    node.fail("R_B_S", "must be a rotation: orthonormal rows, right-handed");
  std::copy(rotation.begin(), rotation.end(), options.R_B_S.begin());
  node.finish();
}

void read_lines(ConfigNode node, LineOptions& options) {
  node.read("port", options.port);
  node.read("baud", options.baud, 1, 4000000);
  std::string clock = options.utc ? "utc" : "own";
  node.read("clock", clock);
  if (clock != "own" && clock != "utc") node.fail("clock", "must be own or utc");
  options.utc = clock == "utc";
  options.channels = {channel::kImu};
  node.read("channels", options.channels);
  for (const std::string& name : options.channels) {
    const bool known = name == channel::kImu || name == channel::kMagnetometer || name == channel::kCompass ||
                       name == channel::kAltitude;
    if (!known) node.fail("channels", "holds '" + name + "'; it may hold IMU, MAGNETOMETER, COMPASS and ALTITUDE");
  }
  node.finish();
}

}  // namespace

SensorOptions SensorOptions::load(const std::filesystem::path& config_folder) {
  ConfigNode node = ConfigNode::load(config_folder / "ingest.yaml");
  SensorOptions options;
  read_camera(node.child_or_empty("camera"), options.camera);
  read_iio(node.child_or_empty("iio_imu"), IioOptions::Kind::kImu, options.iio_imu);
  read_iio(node.child_or_empty("iio_magnetometer"), IioOptions::Kind::kMagnetometer, options.iio_magnetometer);
  read_lines(node.child_or_empty("lines"), options.lines);
  node.read("silence_s", options.silence_s, 0.05, 10);
  node.finish();
  if (options.camera.source.empty() && options.iio_imu.device.empty() && options.iio_magnetometer.device.empty() &&
      options.lines.port.empty()) {
    throw ConfigError((config_folder / "ingest.yaml").string() +
                      ": names no sensor: set camera.source, iio_imu.device, iio_magnetometer.device or lines.port");
  }
  return options;
}

std::vector<std::unique_ptr<Device>> make_devices(const SensorOptions& options, const HostClock& clock) {
  std::vector<std::unique_ptr<Device>> devices;
  if (!options.camera.source.empty()) devices.push_back(std::make_unique<VideoDevice>(options.camera, clock));
  for (const IioOptions& iio : {options.iio_imu, options.iio_magnetometer}) {
    if (!iio.device.empty()) devices.push_back(std::make_unique<IioDevice>(iio, clock));
  }
  if (!options.lines.port.empty()) devices.push_back(std::make_unique<LineDevice>(options.lines, clock));
  return devices;
}

void prepare_sensors(const std::filesystem::path& config_folder) {
  const SensorOptions options = SensorOptions::load(config_folder);
  const HostClock clock;
  for (const IioOptions& iio : {options.iio_imu, options.iio_magnetometer}) {
    if (!iio.device.empty()) IioDevice(iio, clock).set_up();
  }
}

}  // namespace orthonav::ingest
