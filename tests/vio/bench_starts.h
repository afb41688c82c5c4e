// How sessions start at many moments of a flight, for vio_bench.
#pragma once

#include <vector>

#include "tests/vio/bench_run.h"

namespace orthonav::vio {

struct StartOptions {
  int count = 20;
  double until = 60;  // s, the last moment to start at
  unsigned seed = 1;
  double image_noise = 0;  // as in BenchRun
};

struct Start {
  double begin = 0;        // s of the input
  double took = -1;        // s, from the first image to the first state; negative: did not start
  double observable = -1;  // s, from the first image until motion made the scale observable; negative: it did not
  double scale_error = 0;  // relative, at the start
  double scale_later = 0;  // likewise, five seconds later
  bool restarted = false;  // within those five seconds, or published anew
  std::string reason;      // where it did not start
};

// Starts at random moments, prints a line of each and adds them to `starts`.
//
// The scale's error is that of the height above ground at the first state where the input knows the height, and that of
// the way flown in the two seconds after it where not. Motion makes the scale observable when its way since the first
// image departs from a uniformly accelerated one (which a tilt and the accelerometer's bias explain as well) by a
// milliradian, root mean square, seen over the height above ground or over two metres in a room: thrice what the
// gyroscope's own random walk makes of four seconds.
void run_starts(const BenchInput& input, const StartOptions& options, std::vector<Start>& starts);

// The same for sessions that are ended in flight, every `every` seconds of a flight log: how soon the next one flies.
void run_resets(const BenchInput& input, double every, std::vector<Start>& starts);

// One line on all of them.
void print_summary(const std::vector<Start>& starts);

}  // namespace orthonav::vio
