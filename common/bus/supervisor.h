// Tells systemd, where it started this process with Type=notify, that the service is up and that its loop turns.
#pragma once

#include <chrono>
#include <string>

namespace orthonav {

class Supervisor {
 public:
  Supervisor();
  // The loop runs. Sends READY=1 the first time and then the watchdog's keep-alive four times per WatchdogSec, however
  // often it is called. Does nothing without systemd. Call from the loop that does the work, so that a handler that
  // hangs is seen.
  void alive();
  // One line for `systemctl status`.
  void status(const std::string& text) const;

 private:
  std::chrono::microseconds period_{0};
  bool ready_ = false;
  std::chrono::steady_clock::time_point last_;
};

}  // namespace orthonav
