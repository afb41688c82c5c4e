#include "common/bus/process_usage.h"

#include <fstream>

#include <sys/resource.h>
#include <unistd.h>

namespace orthonav {

double ProcessUsage::cpu_seconds() {
  rusage usage{};
  getrusage(RUSAGE_SELF, &usage);
  const auto seconds = [](const timeval& t) {
    return static_cast<double>(t.tv_sec) + 1e-6 * static_cast<double>(t.tv_usec);
  };
  return seconds(usage.ru_utime) + seconds(usage.ru_stime);
}

double ProcessUsage::cpu_percent() {
  const auto now = std::chrono::steady_clock::now();
  const double cpu = cpu_seconds(), elapsed = std::chrono::duration<double>(now - last_).count();
  const double percent = elapsed > 0 ? 100 * (cpu - last_cpu_) / elapsed : 0;
  last_ = now;
  last_cpu_ = cpu;
  return percent;
}

double ProcessUsage::resident_bytes() {
  std::ifstream statm("/proc/self/statm");
  double total = 0, resident = 0;
  statm >> total >> resident;
  return resident * static_cast<double>(sysconf(_SC_PAGESIZE));
}

}  // namespace orthonav
