// The sensors of this board, from an aircraft's ingest.yaml.
#pragma once

#include <filesystem>
#include <memory>
#include <vector>

#include "services/ingest/iio_device.h"
#include "services/ingest/line_device.h"
#include "services/ingest/video_device.h"

namespace orthonav::ingest {

struct SensorOptions {
  VideoOptions camera;
  IioOptions iio_imu;
  IioOptions iio_magnetometer;
  LineOptions lines;
  double silence_s = 0.5;

  // Reads `config_folder`/ingest.yaml. Throws ConfigError with file and line, also when it names no sensor at all.
  static SensorOptions load(const std::filesystem::path& config_folder);
};

// The devices that the options name. `clock` outlives them.
std::vector<std::unique_ptr<Device>> make_devices(const SensorOptions& options, const HostClock& clock);

// Sets up what only root may (IIO's channels, rates and buffers), so that the service can do without.
void prepare_sensors(const std::filesystem::path& config_folder);

}  // namespace orthonav::ingest
