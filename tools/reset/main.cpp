// Ends the odometry's session in flight, and waits for the next one.
#include <chrono>
#include <cstdio>
#include <optional>
#include <string>

#include <CLI/CLI.hpp>
#include <fmt/format.h>

#include "common/bus/channels.h"
#include "common/bus/node.h"
#include "orthonav/vio_reset_t.hpp"
#include "orthonav/vio_state_t.hpp"

namespace {

using namespace orthonav;
using std::chrono::milliseconds;

constexpr double kSilence = 2;  // s without a VIO_STATE: nobody is there

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{
      "Asks the odometry to begin anew, in flight, and waits until it flies again.\n"
      "Exit code: 0 a new session flies; 1 it refused or does not start in time; 2 there is no odometry; 3 no bus."};
  std::string url, key_file, reason = "the operator";
  double seconds = 30;
  app.add_option("--lcm-url", url, "bus to join (default: LCM_DEFAULT_URL, else this machine only)");
  app.add_option("--bus-key", key_file, "key of the bus's authenticated mode (default: ORTHONAV_BUS_KEY, else none)");
  app.add_option("--reason", reason, "shown in the odometry's health")->capture_default_str();
  app.add_option("--seconds", seconds, "how long to wait")->capture_default_str()->check(CLI::Range(1.0, 600.0));
  CLI11_PARSE(app, argc, argv);
  try {
    Node node({.service = "reset", .lcm_url = url, .key_file = key_file, .heartbeat = false});
    std::optional<vio_state_t> before, now;
    int status = 2;
    node.subscribe<vio_state_t>(channel::kVioState, Delivery::kAll, [&](const vio_state_t& state) {
      now = state;
      if (!before) {
        before = state;
        vio_reset_t request{};
        request.utime = node.now();
        request.reason = reason;
        node.publish(channel::kVioReset, request);
        status = 1;
        return;
      }
      const bool was_flying = before->status != vio_state_t::INITIALISING;
      const bool flies = state.status != vio_state_t::INITIALISING;
      if (!flies || (was_flying && state.session == before->session)) return;
      status = 0;
      node.stop();
    });
    double waited = 0;
    constexpr milliseconds kTick{100};
    node.every(kTick, [&] {
      waited += 1e-3 * static_cast<double>(kTick.count());
      if (waited > seconds || (!before && waited > kSilence)) node.stop();
    });
    node.run();
    if (status == 2) {
      fmt::print(stderr, "no VIO_STATE for {} s: no odometry on this bus\n", kSilence);
    } else if (status == 1 && now->status != vio_state_t::INITIALISING) {
      fmt::print(stderr, "session {} goes on: see the odometry's health (orthonav-status)\n", now->session);
    } else if (status == 1) {
      fmt::print(stderr, "session {} has ended; the next has not begun within {} s: see orthonav-status\n",
                 before->session, seconds);
    } else {
      fmt::print("session {} flies, {:.1f} s after the request\n", now->session,
                 1e-6 * static_cast<double>(now->utime - before->utime));
    }
    return status;
  } catch (const std::exception& error) {
    fmt::print(stderr, "orthonav-reset: {}\n", error.what());
    return 3;
  }
}
