// Flies a scenario over a world and writes what the aircraft's sensors measured.
#pragma once

#include <cstdint>
#include <filesystem>
#include <functional>

#include "tools/simulate/scenario.h"
#include "tools/simulate/world.h"

namespace orthonav::simulate {

struct RecordingOptions {
  std::filesystem::path log;                                     // the LCM log to write
  std::filesystem::path asl_folder;                              // empty: none
  double seconds = 0;                                            // s of the flight to record; 0: all of it
  int threads = 1;                                               // that render; the log does not depend on it
  std::function<void(double flown_s, double total_s)> progress;  // may be empty
};

struct RecordingSummary {
  double seconds = 0;         // s recorded
  double path_length = 0;     // m, of the whole flight
  double mean_tilt = 0;       // rad, of the whole flight
  double flight_seconds = 0;  // s, of the whole flight
  size_t images = 0, imu_samples = 0;
  double outside = 0;  // largest fraction of an image that saw beyond the world
};

// Plans the flight of `seed`, renders it and writes the log in time order. The same arguments give the same bytes.
// Throws std::invalid_argument for a flight that cannot be flown and std::runtime_error naming a file.
RecordingSummary record_flight(const Scenario& scenario, const World& world, uint64_t seed,
                               const RecordingOptions& options);

}  // namespace orthonav::simulate
