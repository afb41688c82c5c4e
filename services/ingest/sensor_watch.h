// Tells when a sensor has stopped or gone mad, and when it is sound again. One for each channel.
#pragma once

#include <cstdint>
#include <deque>
#include <string>

#include "services/ingest/imu_watch.h"
#include "services/ingest/sensor_source.h"

namespace orthonav::ingest {

class SensorWatch {
 public:
  // `silence`, s: the longest pause that is no complaint.
  explicit SensorWatch(std::string channel, double silence = 0.5);

  // A message came at `now` (microseconds, of a clock that does not jump), when the board had turned by `yaw` (rad,
  // from any start, as its IMU integrates it). Says whether the sensor is frozen and measures nothing: an IMU that
  // reads the very same on all axes for 0.3 s, a camera that shows the very same for 0.8 s (and 4 images), a compass or
  // a magnetometer that reads the very same for 0.5 s (and 4 times) in which the board turned by 20 degrees within 2 s.
  bool frozen(const SensorMessage& message, int64_t now, double yaw);
  // The IMU by which the board turned is mad: no compass is frozen for that.
  void forget_turn(int64_t now, double yaw);
  // What became of it: `fault` is what was wrong with it, empty when it was published.
  void judged(const SensorMessage& message, const std::string& fault, int64_t now);

  // What is wrong with the sensor now; empty when nothing is: frozen or refused, silent or slower than it was, and an
  // IMU whose readings are no aircraft's (imu_watch.h). Silence is counted from `now` of the first call at the latest;
  // to be called ten times a second.
  std::string complaint(int64_t now);

 private:
  std::string slowness(size_t good, int64_t now);

  std::string channel_;
  double silence_;
  int64_t window_;  // microseconds over which messages are counted
  int64_t last_good_ = 0;
  bool ever_good_ = false;
  size_t reading_ = 0;      // a hash of the last one
  int64_t same_since_ = 0;  // when it was read first
  int same_count_ = 0;
  int64_t yaw_time_ = 0;  // when the board's yaw was yaw_, at most 2 s ago
  double yaw_ = 0;
  bool turned_ = false;  // since it was read first
  bool frozen_ = false;
  struct Judgement {
    int64_t time;
    bool refused;
  };
  std::deque<Judgement> recent_;  // of the last window
  std::string last_fault_;
  std::deque<size_t> counts_;  // of good messages, in windows that were not slow
  int64_t counted_ = 0;        // when the last of them ended
  bool slow_ = false;
  ImuWatch imu_;
};

}  // namespace orthonav::ingest
