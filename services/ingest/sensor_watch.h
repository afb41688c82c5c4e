// Tells when a sensor has stopped or gone mad, and when it is sound again. One for each channel.
#pragma once

#include <cstdint>
#include <deque>
#include <string>

#include "services/ingest/sensor_source.h"

namespace orthonav::ingest {

class SensorWatch {
 public:
  // `silence`, s: the longest pause that is no complaint.
  explicit SensorWatch(std::string channel, double silence = 0.5) : channel_(std::move(channel)), silence_(silence) {}

  // A message came at `now` (microseconds, of a clock that does not jump). Says whether the sensor is frozen: an IMU
  // that reads the very same on all axes for 0.3 s, or a camera that shows the very same for 0.8 s (and 4 images),
  // measures nothing.
  bool frozen(const SensorMessage& message, int64_t now);
  // What became of it: `fault` is what was wrong with it, empty when it was published.
  void judged(const std::string& fault, int64_t now);

  // What is wrong with the sensor now; empty when nothing is. Silence is counted from `now` of the first call at the
  // latest.
  std::string complaint(int64_t now);

 private:
  std::string channel_;
  double silence_;
  int64_t last_good_ = 0;
  bool ever_good_ = false;
  size_t reading_ = 0;      // a hash of the last one
  int64_t same_since_ = 0;  // when it was read first
  int same_count_ = 0;
  struct Judgement {
    int64_t time;
    bool refused;
  };
  std::deque<Judgement> recent_;  // of the last half second
  std::string last_fault_;
};

}  // namespace orthonav::ingest
