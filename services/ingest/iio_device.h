// An IMU or a magnetometer behind Linux's Industrial I/O: buffered records with the kernel's time stamps.
#pragma once

#include <array>
#include <filesystem>

#include "services/ingest/device.h"
#include "services/ingest/iio_scan.h"
#include "services/ingest/sensor_clock.h"

namespace orthonav::ingest {

struct IioOptions {
  enum class Kind { kImu, kMagnetometer };
  Kind kind = Kind::kImu;
  std::string device;  // its name, as in the file `name` of its folder, or the folder's own name; empty: none
  std::filesystem::path sysfs = "/sys/bus/iio/devices";    // folder with iio:device0, ...
  std::filesystem::path dev = "/dev";                      // folder with the character devices of these names
  double rate_hz = 0;                                      // asked of the sensor; 0: as it is
  int buffer_length = 256;                                 // records the kernel keeps
  std::array<double, 9> R_B_S{1, 0, 0, 0, 1, 0, 0, 0, 1};  // from the sensor's axes to the body's, row by row
};

// Angular rate and specific force come from one device: a board with two is not supported. The kernel's mount matrix is
// not used; R_B_S says it all.
class IioDevice : public Device {
 public:
  IioDevice(IioOptions options, const HostClock& clock);
  ~IioDevice() override;
  IioDevice(const IioDevice&) = delete;
  IioDevice& operator=(const IioDevice&) = delete;

  std::string name() const override;
  std::vector<std::string> channels() const override;
  // Finds the device, sets its channels, rate and buffer up (writing only what is otherwise than wanted), and opens it.
  void open() override;
  bool read(std::chrono::milliseconds patience, std::vector<SensorEvent>& events) override;

  // Sets the device up without opening it: the part of open() that needs the right to write into sysfs.
  void set_up();

 private:
  std::filesystem::path find() const;
  void close();
  SensorEvent event_of(const uint8_t* record) const;

  IioOptions options_;
  const HostClock& clock_;
  std::filesystem::path folder_;
  std::vector<IioChannel> channels_;
  std::array<size_t, 7> order_{};  // where in channels_: the six or three axes, the time last
  size_t record_length_ = 0;
  bool monotonic_ = false;  // the clock of the kernel's stamps
  int fd_ = -1;
  std::vector<uint8_t> rest_;  // of a record that was not whole
};

}  // namespace orthonav::ingest
