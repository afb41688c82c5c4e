// What this process takes of its board: processor time and memory, from /proc/self.
#pragma once

#include <chrono>

namespace orthonav {

class ProcessUsage {
 public:
  // Processor time since the call before this one (the construction, for the first), all threads, in percent of one
  // core.
  double cpu_percent();
  // Resident memory now, bytes; 0 where /proc cannot be read.
  static double resident_bytes();
  // Processor time of the process so far, all threads.
  static double cpu_seconds();

 private:
  double last_cpu_ = cpu_seconds();
  std::chrono::steady_clock::time_point last_ = std::chrono::steady_clock::now();
};

}  // namespace orthonav
