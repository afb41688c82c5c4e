// Puts a recorded flight on the bus: reads a source, validates, paces by the time stamps, publishes, reports. The
// sensors of a board: sensor_service.h.
#pragma once

#include <filesystem>
#include <memory>
#include <set>
#include <string>
#include <vector>

#include "common/bus/service_main.h"
#include "services/ingest/compass.h"
#include "services/ingest/sensor_source.h"
#include "services/ingest/validator.h"

namespace orthonav::ingest {

struct IngestOptions {
  std::filesystem::path log;          // an LCM log, or
  std::filesystem::path asl;          // an EuRoC/ASL folder
  double speed = 1.0;                 // times real time
  std::vector<std::string> wait_for;  // services whose heartbeat must be seen before the first message
  bool progress = false;              // a progress line on standard error
};

// Opens the source that the options name. Throws std::runtime_error naming what is missing.
std::unique_ptr<SensorSource> make_source(const IngestOptions& options);

// Checks a message and publishes it if it is sound; counts it in the node's health either way. Shared by the live
// service and the replay. A raw magnetometer sample is followed by the heading that `compass` makes of it. Returns what
// was wrong with the event, empty when it was published.
std::string publish_checked(Node& node, Validator& validator, Compass& compass, const SensorEvent& event);

class IngestService : public Service {
 public:
  // Throws std::runtime_error as make_source does, ConfigError as Compass::load does.
  IngestService(Node& node, const std::filesystem::path& config, const IngestOptions& options);

 private:
  void tick();
  void report();

  Node& node_;
  IngestOptions options_;
  std::unique_ptr<SensorSource> source_;
  Validator validator_;
  Compass compass_;
  std::set<std::string> awaited_;
  std::optional<SensorEvent> pending_;
  int64_t first_utime_ = 0;
  int64_t last_utime_ = 0;
  std::chrono::steady_clock::time_point start_;
};

}  // namespace orthonav::ingest
