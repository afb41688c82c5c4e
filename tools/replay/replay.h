// A flight through all services in one process: as fast as the machine allows, and bit for bit the same each time.
//
// The services are the very classes that run as processes on the live bus, each on a Node of its own; the nodes
// share one memq:// instance of LCM. After each sensor message everything it caused is handled before the next one.
#pragma once

#include <cstdint>
#include <filesystem>
#include <functional>
#include <string>
#include <vector>

namespace orthonav::replay {

// A service that ends in flight and is started again: with nothing but what it keeps on purpose (--memory).
struct Restart {
  std::string service;  // map_server, registration, vio or fusion
  double at = 0;        // s of flight
  double down = 0.5;    // s until it is there again; as its unit has it
};

// One of several flights in a row.
struct LoopSummary {
  double hours = 0;          // flown so far
  double cpu_ms = 0;         // of processor per image, in this one
  double resident_mb = 0;    // memory at its end, 10^6 bytes
  double aided_percent = 0;  // of its NAV_STATE, those aided by the map
  int sessions = 0;          // of the odometry so far
};

struct ReplayOptions {
  std::filesystem::path config;      // folder of the aircraft or scenario; may be empty with `asl`: the
                                     // odometry alone, with its default parameters
  std::filesystem::path log;         // an LCM log, or
  std::filesystem::path asl;         // an EuRoC/ASL folder, whose calibration the odometry takes
  std::filesystem::path map;         // raster or map database; empty: odometry alone
  std::filesystem::path out;         // LCM log of everything that was on the bus (the last time); empty: none
  std::filesystem::path trajectory;  // the odometry's states in TUM's format; empty: none
  std::filesystem::path times;       // CSV, a line per image: what the odometry made of it; empty: none
  std::vector<Restart> restarts;
  int loops = 1;  // times that the same services fly the source, 10 s after one another
  std::function<void(const LoopSummary&)> landed;  // called after each of them; may be empty
  std::filesystem::path memory;                    // folder where vio and fusion keep what they go on with; empty: none
  std::function<void(double fraction)> progress;   // called about once per second of flight; may be empty
};

struct ReplaySummary {
  double flight_seconds = 0;  // first to last sensor message
  int64_t messages = 0;       // written to the output
};

// Replays the whole source. Throws std::runtime_error or ConfigError naming the file at fault. One replay at a time
// per process, since random generators of libraries are seeded anew.
ReplaySummary replay(const ReplayOptions& options);

}  // namespace orthonav::replay
