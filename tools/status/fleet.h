// Every service's newest heartbeat, and a terminal table of them.
//
// Rates and drops are differences of the counters of two heartbeats, so a second of listening shows them. A service is
// known by its name and host; one that has been silent for three seconds is shown as LOST.
#pragma once

#include <cstdint>
#include <map>
#include <string>
#include <vector>

#include "orthonav/health_t.hpp"

namespace orthonav::status {

// What scripts ask for: the worst of all services. The process's exit code.
enum class Verdict { kOk = 0, kNotReady = 1, kBad = 2 };

struct Row {
  std::string service, host, version, state, message;
  int pid = 0;
  double uptime = 0;       // s
  double cpu_percent = 0;  // of one core
  double memory_mb = 0;    // resident, 10^6 bytes
  double in_hz = 0;        // messages received
  double out_hz = 0;       // messages published
  double latency_ms = 0;   // slowest message of the last second, from the socket to the end of its handler
  double rejected = 0;     // messages refused since the start: undecodable, implausible, overrun
  double rejected_hz = 0;  // of them in the last second
  double skew_ms = 0;      // largest difference to another board's clock as the service sees it
};

class Fleet {
 public:
  // `expected`: services that must be there; one without a heartbeat is shown as MISSING.
  explicit Fleet(std::vector<std::string> expected) : expected_(std::move(expected)) {}

  // Takes a heartbeat received at `now` (microseconds, any steady clock).
  void add(const health_t& heartbeat, int64_t now);

  // One row a service, by name and host; the expected ones that are missing last.
  std::vector<Row> rows(int64_t now) const;

  // kBad: a service FAILED, LOST or MISSING, or no service at all. kNotReady: one STARTING or DEGRADED.
  Verdict verdict(int64_t now) const;

 private:
  struct Entry {
    health_t newest, before;
    int64_t received = 0;
    bool has_before = false;
  };
  std::vector<std::string> expected_;
  std::map<std::string, Entry> entries_;
};

// The table as text, lines no wider than the columns need; `colour` for a terminal.
std::string to_text(const std::vector<Row>& rows, bool colour);
// The same as a JSON array of objects with the members of Row as keys.
std::string to_json(const std::vector<Row>& rows);

}  // namespace orthonav::status
