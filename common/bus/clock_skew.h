// How far other boards' clocks are from this one's, from the heartbeats they send.
//
// A heartbeat carries the sender's wall clock; its arrival here is later by the transport (0.1–2 ms on a quiet
// network), so of the last ten seconds the smallest difference counts. Not thread-safe.
#pragma once

#include <cstdint>
#include <deque>
#include <map>
#include <string>

namespace orthonav {

class ClockSkew {
 public:
  // A heartbeat of `host`, sent at its time `sent`, received at ours `received`; microseconds since the Unix epoch.
  void add(const std::string& host, int64_t sent, int64_t received);

  // Our clock minus theirs, seconds, by host. Hosts silent for ten seconds before `now` are left out.
  std::map<std::string, double> skews(int64_t now) const;

 private:
  struct Sample {
    int64_t received, difference;
  };
  std::map<std::string, std::deque<Sample>> samples_;
};

}  // namespace orthonav
