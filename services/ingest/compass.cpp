#include "services/ingest/compass.h"

namespace orthonav::ingest {

Compass Compass::load(const std::filesystem::path& config_folder) {
  const auto file = config_folder / "compass.yaml";
  return std::filesystem::exists(file) ? Compass(MagneticCalibration::load(file)) : Compass();
}

std::optional<compass_t> Compass::feed(const SensorMessage& message) {
  if (!calibration_) return std::nullopt;
  if (const auto* imu = std::get_if<imu_t>(&message)) {
    level_.feed(imu->utime, Eigen::Map<const Eigen::Vector3d>(imu->angular_rate),
                Eigen::Map<const Eigen::Vector3d>(imu->specific_force));
  } else if (const auto* sample = std::get_if<magnetometer_t>(&message); sample != nullptr && level_.up_B()) {
    compass_t compass;
    compass.utime = sample->utime;
    compass.heading =
        magnetic_heading(calibration_->correct(Eigen::Map<const Eigen::Vector3d>(sample->field)), *level_.up_B());
    compass.heading_stddev = calibration_->heading_stddev;
    return compass;
  }
  return std::nullopt;
}

}  // namespace orthonav::ingest
