// Where sensor data comes from: a recorded flight or a dataset. (The sensors of a board are devices, device.h.)
//
// To add a source, derive from SensorSource, add a branch to make_source() in ingest_service.cpp, and a test in
// tests/ingest. Everything behind this interface (validation, pacing, publishing, health) is shared.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <variant>

#include "orthonav/altitude_t.hpp"
#include "orthonav/compass_t.hpp"
#include "orthonav/gnss_reference_t.hpp"
#include "orthonav/image_t.hpp"
#include "orthonav/imu_t.hpp"
#include "orthonav/magnetometer_t.hpp"
#include "orthonav/truth_t.hpp"

namespace orthonav::ingest {

// A sensor's message, stamped by the sensor.
using SensorMessage = std::variant<imu_t, image_t, compass_t, magnetometer_t, altitude_t, gnss_reference_t, truth_t>;

int64_t utime_of(const SensorMessage& message);
// Name of the channel the message belongs on.
const char* channel_of(const SensorMessage& message);

// A message, or the reason why a stretch of the source could not be read as one.
struct SensorEvent {
  std::optional<SensorMessage> message;
  std::string error;  // names the file and line or channel at fault
};

class SensorSource {
 public:
  virtual ~SensorSource() = default;
  // The next event in the order of the source, nullopt at its end. Never throws after construction.
  virtual std::optional<SensorEvent> next() = 0;
  // How far through the source, 0..1, for progress.
  virtual double progress() const = 0;
};

}  // namespace orthonav::ingest
