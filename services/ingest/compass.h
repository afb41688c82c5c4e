// COMPASS from a raw magnetometer: corrected for the aircraft's iron, levelled with the IMU.
#pragma once

#include <optional>

#include "common/compass/level.h"
#include "common/compass/magnetic_calibration.h"
#include "services/ingest/sensor_source.h"

namespace orthonav::ingest {

class Compass {
 public:
  // Reads `config_folder`/compass.yaml where there is one; without it no heading is made. Throws ConfigError.
  static Compass load(const std::filesystem::path& config_folder);
  Compass() = default;
  explicit Compass(const MagneticCalibration& calibration) : calibration_(calibration) {}

  // Takes every accepted sensor message; a magnetometer_t gives a heading once the IMU has said where up is.
  std::optional<compass_t> feed(const SensorMessage& message);

  // The source has a compass of its own: no heading is made from now on.
  void stand_back() { calibration_.reset(); }

 private:
  std::optional<MagneticCalibration> calibration_;
  Level level_;
};

}  // namespace orthonav::ingest
