// Runs the odometry over recorded flights and EuRoC/ASL folders, for vio_bench.
#pragma once

#include <cstdint>
#include <filesystem>
#include <limits>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "services/vio/vio.h"

namespace orthonav::vio {

struct Pose {
  Eigen::Vector3d p;     // m
  Eigen::Quaterniond q;  // of the body
};

struct BenchInput {
  std::filesystem::path path;  // a flight log, or an EuRoC/ASL folder
  bool asl = false;
  VioSetup setup;  // of an ASL folder: what its sensor.yaml does not say
};

struct BenchRun {
  double begin = 0;                                              // s of the input that are passed over
  double duration = std::numeric_limits<double>::infinity();     // s
  double after_start = std::numeric_limits<double>::infinity();  // s, to run on after the first state
  double image_noise = 0;                                        // grey levels, 1 sigma, added to the images
  double reset_every = std::numeric_limits<double>::infinity();  // s of a flight log
  bool verbose = false;                                          // a line per keyframe
};

struct Result {
  std::vector<VioOutput> outputs;
  std::vector<double> ms;  // of this thread's CPU, per output: a loaded machine does not count
  std::map<int64_t, Pose> truth;
  std::map<int64_t, double> height;  // m above the surface
  std::map<std::string, double> counters;

  std::optional<int64_t> started() const;  // time of the first state
};

// Truth at a time, between its samples.
std::optional<Pose> truth_at(const std::map<int64_t, Pose>& truth, int64_t utime);

Result run_input(const BenchInput& input, const BenchRun& run);

// Feeds a log to the odometry, all time stamps later by `later` (microseconds); returns the last of them.
int64_t feed_log(const std::filesystem::path& file, const BenchRun& run, int64_t later, Vio& vio, Result& result);

}  // namespace orthonav::vio
