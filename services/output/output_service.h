// Hands NAV_STATE on to programs that speak no LCM: NMEA 0183 over UDP and over a serial line, each behind its own
// switch in output.yaml.
#pragma once

#include <filesystem>
#include <memory>
#include <string>
#include <vector>

#include "common/bus/nav_guard.h"
#include "common/bus/node.h"
#include "common/bus/service_main.h"
#include "orthonav/nav_state_t.hpp"
#include "services/output/options.h"
#include "services/output/sinks.h"

namespace orthonav::output {

// What a navigation state is worth to a reader of NMEA, and its figures.
Report report_of(const nav_state_t& nav);

class OutputService final : public Service {
 public:
  // Reads output.yaml of the folder. Throws ConfigError with file and line.
  OutputService(Node& node, const std::filesystem::path& config_folder);

 private:
  void on_nav(const nav_state_t& nav);

  struct Output {
    std::string name;  // in the health
    std::unique_ptr<Sink> sink;
  };
  Node& node_;
  OutputOptions options_;
  std::vector<Output> outputs_;
  NavGuard guard_;
  int64_t newest_ = 0;  // utime of the newest state sent
};

}  // namespace orthonav::output
