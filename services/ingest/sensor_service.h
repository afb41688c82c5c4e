// Puts the sensors of this board on the bus as they measure: validates, watches, publishes, reports.
//
// A sensor that stops, is refused, freezes, slows down or measures what no aircraft does (sensor_watch.h) makes the
// service DEGRADED within a second (silence: silence_s and a tenth), naming the channel and the device's trouble, and
// OK again as soon as it is back; no other sensor waits for it.
#pragma once

#include <filesystem>
#include <map>
#include <memory>
#include <vector>

#include "common/bus/service_main.h"
#include "services/ingest/compass.h"
#include "services/ingest/device_reader.h"
#include "services/ingest/sensor_clock.h"
#include "services/ingest/sensor_watch.h"
#include "services/ingest/validator.h"

namespace orthonav::ingest {

class SensorService : public Service {
 public:
  // Reads `config`/ingest.yaml. Throws ConfigError; a sensor that cannot be opened is no error but a complaint.
  SensorService(Node& node, const std::filesystem::path& config);

 private:
  void publish_what_came();
  void turn(const imu_t& imu);  // adds to yaw_
  void watch();

  Node& node_;
  HostClock clock_;
  Validator validator_;
  Compass compass_;
  std::map<std::string, SensorWatch> watches_;  // by channel
  std::vector<std::unique_ptr<DeviceReader>> readers_;
  std::vector<SensorEvent> events_;
  double yaw_ = 0;  // rad about the body's z, integrated, from any start
  int64_t imu_utime_ = 0;
  std::string words_;  // of the last complaint
};

}  // namespace orthonav::ingest
