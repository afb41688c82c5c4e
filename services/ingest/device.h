// A sensor of this board: something that is opened, waits for data, and may go away and come back.
//
// To add one, derive from Device, read its options in sensor_options.cpp and make it in make_devices(). DeviceReader
// gives it a thread, opens it again after a failure, and SensorService validates, watches and publishes what it says.
#pragma once

#include <chrono>
#include <string>
#include <vector>

#include "services/ingest/sensor_source.h"

namespace orthonav::ingest {

class Device {
 public:
  virtual ~Device() = default;
  // For messages: the file, address or pipeline that is read.
  virtual std::string name() const = 0;
  // The channels on which data is expected all the time.
  virtual std::vector<std::string> channels() const = 0;
  // Opens it, or opens it again. Throws std::runtime_error saying what is missing and what to do.
  virtual void open() = 0;
  // Waits about `patience` for data and appends what came, stamped. False: it is at its end for good (a file). Throws
  // std::runtime_error when the device is gone. One thread calls open() and read().
  virtual bool read(std::chrono::milliseconds patience, std::vector<SensorEvent>& events) = 0;
};

}  // namespace orthonav::ingest
