// A terminal table of every service on the bus.
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>
#include <fmt/format.h>
#include <lcm/lcm-cpp.hpp>
#include <unistd.h>

#include "common/bus/channels.h"
#include "common/bus/node.h"
#include "tools/status/fleet.h"

namespace {

using namespace orthonav;

int64_t monotonic() {
  return std::chrono::duration_cast<std::chrono::microseconds>(std::chrono::steady_clock::now().time_since_epoch())
      .count();
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{
      "Shows every service's health: state, rates, latency, refusals, processor, memory, clock, last error.\n"
      "Exit code: 0 all OK; 1 one is STARTING or DEGRADED; 2 one is FAILED, LOST or MISSING, or none is there; 3 no "
      "bus."};
  std::string url;
  std::vector<std::string> expected{"ingest", "vio", "map_server", "registration", "fusion"};
  double seconds = 2.5;
  bool watch = false, json = false;
  app.add_option("--lcm-url", url, "bus to join (default: LCM_DEFAULT_URL, else this machine only)");
  app.add_option("--expect", expected, "services that must be there")->delimiter(',')->capture_default_str();
  app.add_option("--seconds", seconds, "how long to listen")->capture_default_str()->check(CLI::Range(0.1, 3600.0));
  app.add_flag("--watch", watch, "show the table anew every second until interrupted");
  app.add_flag("--json", json, "JSON in place of the table");
  CLI11_PARSE(app, argc, argv);
  try {
    const auto bus = join_bus({.service = "status", .lcm_url = url});
    status::Fleet fleet(expected);
    const std::function<void(const lcm::ReceiveBuffer*)> take = [&](const lcm::ReceiveBuffer* buffer) {
      health_t heartbeat;
      if (heartbeat.decode(buffer->data, 0, static_cast<int>(buffer->data_size)) >= 0)
        fleet.add(heartbeat, monotonic());
    };
    using Take = std::function<void(const lcm::ReceiveBuffer*)>;
    bus->subscribeFunction(
        channel::kHealth, +[](const lcm::ReceiveBuffer* buffer, const std::string&, const Take* f) { (*f)(buffer); },
        &take);
    const bool terminal = isatty(STDOUT_FILENO) == 1;
    const auto show = [&] {
      const auto rows = fleet.rows(monotonic());
      fmt::print("{}", json ? status::to_json(rows) : status::to_text(rows, terminal));
      std::fflush(stdout);
    };
    for (;;) {
      const int64_t end = monotonic() + static_cast<int64_t>(1e6 * (watch ? 1.0 : seconds));
      for (int64_t left = end - monotonic(); left > 0; left = end - monotonic()) {
        bus->handleTimeout(static_cast<int>(std::min<int64_t>(left / 1000 + 1, 100)));
      }
      if (watch && terminal && !json) fmt::print("\033[H\033[2J");
      show();
      if (!watch) return static_cast<int>(fleet.verdict(monotonic()));
    }
  } catch (const std::exception& error) {
    fmt::print(stderr, "orthonav-status: {}\n", error.what());
    return 3;
  }
}
