// What every service's main.cpp does: read arguments, make the node, run it.
#pragma once

#include <filesystem>
#include <functional>
#include <memory>
#include <string>

#include "common/bus/node.h"

namespace CLI {
class App;
}

namespace orthonav {

// A running service: owns its subscriptions through the node it was given.
class Service {
 public:
  virtual ~Service() = default;
};

// Parses --config FOLDER (required; one of config/*), --lcm-url URL and the options that `add_options` adds,
// builds the service on a live node and runs it until SIGINT or SIGTERM. A configuration error or a bus that
// cannot be joined is printed on stderr in one line. Returns the process's exit code: 0, or 1 after an error.
int service_main(int argc, char** argv, const std::string& service, const std::string& description,
                 const std::function<void(CLI::App&)>& add_options,
                 const std::function<std::unique_ptr<Service>(Node&, const std::filesystem::path& config)>& make);

}  // namespace orthonav
