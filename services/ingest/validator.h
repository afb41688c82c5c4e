// Decides whether a sensor's message may go on the bus, and watches the rate of each sensor.
//
// Refused: values that are not finite or that no sensor of a small aircraft reads, time that does not advance, a time
// stamp that jumps by more than an hour, an image whose size disagrees with its data. Gaps are let through and counted:
// a gap is the estimator's to bridge.
#pragma once

#include <cstdint>
#include <map>
#include <string>

#include "services/ingest/sensor_source.h"

namespace orthonav::ingest {

struct Verdict {
  bool accepted = true;
  std::string reason;  // short name for a counter: "nan", "range", "order", "jump", "size"; empty when accepted
  std::string detail;  // one line naming channel, time and value
  bool gap = false;    // accepted, but later than three usual periods after the one before
};

class Validator {
 public:
  // Judges messages of each channel against those accepted before it.
  Verdict check(const SensorMessage& message);

  // Mean rate of a channel over its recent messages, Hz; 0 before there are two.
  double rate_hz(const std::string& channel) const;

 private:
  struct Stream {
    int64_t last_utime = 0;
    double period = 0;  // s, exponential mean; 0: unknown
    int refused_in_a_row = 0;
  };
  std::map<std::string, Stream> streams_;
};

}  // namespace orthonav::ingest
