// The line protocol of serial and network sensors, docs/sensor_lines.md: `$IMU,...*hh`, `$MAG,...*hh`, `$HDG,...*hh`,
// `$ALT,...*hh`.
#pragma once

#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include "services/ingest/sensor_clock.h"
#include "services/ingest/sensor_source.h"

namespace orthonav::ingest {

class SensorLines {
 public:
  // `source` names the port in errors. With `utc`, the sensors' times are microseconds since the Unix epoch on a clock
  // that is right; otherwise microseconds of a clock of their own, one for all lines.
  explicit SensorLines(std::string source, bool utc = false) : source_(std::move(source)), utc_(utc) {}

  // Takes bytes as they came, heard at `arrival` (microseconds since the epoch), and appends an event for each line
  // that ended: a message, or what was wrong with it. Noise between lines is one event, however long it is.
  void feed(std::string_view bytes, int64_t arrival, std::vector<SensorEvent>& events);
  // The port was opened again: what was begun is given up, and the sensor's clock may be another.
  void restart();

 private:
  SensorEvent parse(std::string_view line, int64_t arrival);

  std::string source_;
  bool utc_;
  SensorClock clock_;
  std::string line_;   // begun with $
  int64_t noise_ = 0;  // bytes outside a line since the last one
};

// The exclusive or of all bytes, as between $ and * of a line.
uint8_t line_checksum(std::string_view text);

}  // namespace orthonav::ingest
