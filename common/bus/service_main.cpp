#include "common/bus/service_main.h"

#include <cstdio>

#include <CLI/CLI.hpp>
#include <spdlog/sinks/stdout_color_sinks.h>
#include <spdlog/spdlog.h>

namespace orthonav {

int service_main(int argc, char** argv, const std::string& service, const std::string& description,
                 const std::function<void(CLI::App&)>& add_options,
                 const std::function<std::unique_ptr<Service>(Node&, const std::filesystem::path& config)>& make) {
  CLI::App app{description};
  std::filesystem::path config;
  NodeOptions options;
  options.service = service;
  app.add_option("--config", config, "folder of the aircraft or scenario, e.g. config/rural")
      ->required()
      ->check(CLI::ExistingDirectory);
  app.add_option("--lcm-url", options.lcm_url, "bus to join (default: LCM_DEFAULT_URL, else this machine only)");
  app.add_option(
      "--bus-key", options.key_file,
      "file with the bus's key: seal what is sent, refuse what is not sealed (default: ORTHONAV_BUS_KEY, else "
      "neither)");
  add_options(app);
  CLI11_PARSE(app, argc, argv);
  // Standard output is for results; what a service says goes to standard error.
  spdlog::set_default_logger(spdlog::stderr_color_mt(service));
  try {
    Node node(options);
    const auto instance = make(node, config);
    return node.run();
  } catch (const std::exception& error) {
    std::fprintf(stderr, "orthonav-%s: %s\n", service.c_str(), error.what());
    return 1;
  }
}

}  // namespace orthonav
