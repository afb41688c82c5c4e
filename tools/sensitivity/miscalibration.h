// An aircraft.yaml that is wrong by a known amount.
#pragma once

#include <filesystem>

#include <yaml-cpp/yaml.h>

namespace orthonav::sensitivity {

struct Miscalibration {
  double focal = 1.0;                           // factor on fx and fy
  double principal_u = 0.0, principal_v = 0.0;  // pixels, added to cx and cy
  double distortion = 1.0;                      // factor on every coefficient
  // Degrees, of the camera about the body's axes x (forward), y (left), z (up).
  double roll_deg = 0.0, pitch_deg = 0.0, yaw_deg = 0.0;

  bool operator==(const Miscalibration&) const = default;
};

// What to lay over the aircraft.yaml of `folder` to make it so; empty when nothing is wrong. Throws ConfigError, also
// for an aircraft.yaml whose calibration is Kalibr's.
YAML::Node aircraft_overlay(const std::filesystem::path& folder, const Miscalibration& wrong);

}  // namespace orthonav::sensitivity
