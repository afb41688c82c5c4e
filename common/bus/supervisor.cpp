#include "common/bus/supervisor.h"

#include <cstdint>

#include <systemd/sd-daemon.h>

namespace orthonav {

Supervisor::Supervisor() {
  uint64_t watchdog = 0;
  if (sd_watchdog_enabled(0, &watchdog) > 0) period_ = std::chrono::microseconds(watchdog / 4);
}

void Supervisor::alive() {
  const auto now = std::chrono::steady_clock::now();
  if (!ready_) {
    ready_ = true;
    last_ = now;
    sd_notify(0, "READY=1");
  } else if (period_.count() > 0 && now - last_ >= period_) {
    last_ = now;
    sd_notify(0, "WATCHDOG=1");
  }
}

void Supervisor::status(const std::string& text) const {
  sd_notify(0, ("STATUS=" + text).c_str());
}

}  // namespace orthonav
