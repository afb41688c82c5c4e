// The line protocol (docs/sensor_lines.md) on a serial port or a UDP port.
#pragma once

#include "services/ingest/device.h"
#include "services/ingest/sensor_clock.h"
#include "services/ingest/sensor_lines.h"

namespace orthonav::ingest {

struct LineOptions {
  std::string port;  // /dev/ttyUSB0, or udp://ADDRESS:PORT to listen on; empty: none
  int baud = 460800;
  bool utc = false;                   // the lines' times are UTC on a clock that is right
  std::vector<std::string> channels;  // that must not fall silent: IMU, MAGNETOMETER, COMPASS, ALTITUDE
};

class LineDevice : public Device {
 public:
  LineDevice(LineOptions options, const HostClock& clock);
  ~LineDevice() override;
  LineDevice(const LineDevice&) = delete;
  LineDevice& operator=(const LineDevice&) = delete;

  std::string name() const override { return options_.port; }
  std::vector<std::string> channels() const override { return options_.channels; }
  void open() override;
  bool read(std::chrono::milliseconds patience, std::vector<SensorEvent>& events) override;

 private:
  void close();
  void open_serial();
  void open_udp();

  LineOptions options_;
  const HostClock& clock_;
  SensorLines lines_;
  int fd_ = -1;
};

}  // namespace orthonav::ingest
