// Reads a device on a thread of its own, for as long as the reader lives: opens it, and after a failure again, five
// times a second.
#pragma once

#include <atomic>
#include <condition_variable>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include "services/ingest/device.h"

namespace orthonav::ingest {

class DeviceReader {
 public:
  explicit DeviceReader(std::unique_ptr<Device> device);
  // Waits for the device's read() to return.
  ~DeviceReader();
  DeviceReader(const DeviceReader&) = delete;
  DeviceReader& operator=(const DeviceReader&) = delete;

  // Moves what came since the last call to the end of `events`. Thread-safe.
  void take(std::vector<SensorEvent>& events);
  // Why the device is closed; empty while it is open. Thread-safe.
  std::string trouble() const;
  // The device is at its end for good and everything was taken. Thread-safe.
  bool ended() const;

  const std::string& name() const { return name_; }
  const std::vector<std::string>& channels() const { return channels_; }

 private:
  void run();
  void read_until_it_fails();

  std::unique_ptr<Device> device_;
  const std::string name_;
  const std::vector<std::string> channels_;
  mutable std::mutex mutex_;  // guards the next three
  std::vector<SensorEvent> events_;
  std::string trouble_ = "not open yet";
  bool ended_ = false;
  std::condition_variable stop_;
  std::atomic<bool> stopping_{false};
  std::thread thread_;
};

}  // namespace orthonav::ingest
