// The sensor channels of a recorded LCM log; everything else in it is passed over, so that a log that also holds
// the services' output can be flown again.
#pragma once

#include <filesystem>

#include "common/flightlog/flightlog.h"
#include "services/ingest/sensor_source.h"

namespace orthonav::ingest {

class LogSource : public SensorSource {
 public:
  // Throws std::runtime_error naming the file when it cannot be opened.
  explicit LogSource(const std::filesystem::path& file);

  std::optional<SensorEvent> next() override;
  double progress() const override { return reader_.progress(); }

 private:
  std::filesystem::path file_;
  LogReader reader_;
  int64_t skipped_ = 0;
};

}  // namespace orthonav::ingest
