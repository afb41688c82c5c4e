// Fuses recorded flights anew, from their VIO_STATE, VIO_KEYFRAME, MAP_FIX and COMPASS: what a parameter does, in
// seconds instead of a replay's minutes.
//   bench_recorded CONFIG_FOLDER OUT.lcm...      (logs that orthonav-replay wrote)
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <memory>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>
#include <lcm/lcm-cpp.hpp>

#include "common/bus/channels.h"
#include "common/flightlog/flightlog.h"
#include "common/math/so3.h"
#include "common/math/statistics.h"
#include "orthonav/compass_t.hpp"
#include "services/fusion/fusion_service.h"
#include "tools/evaluate/flight_record.h"
#include "tools/evaluate/metrics.h"

using namespace orthonav;

namespace {

struct NavListener {
  std::vector<nav_state_t> states;
  void receive(const lcm::ReceiveBuffer* /*buffer*/, const std::string& /*channel*/, const nav_state_t* m) {
    if (m->source == nav_state_t::FRAME) states.push_back(*m);
  }
};

void fuse(const std::filesystem::path& config, const std::filesystem::path& log) {
  evaluate::FlightRecord record = evaluate::FlightRecord::read(log);
  lcm::LCM bus("memq://");
  NavListener heard;
  bus.subscribe(channel::kNavState, &NavListener::receive, &heard)->setQueueCapacity(0);
  Node node({.service = "fusion"}, bus);
  fusion::FusionService service(node, config);
  LogReader reader(log);
  const std::set<std::string> inputs{channel::kVioState, channel::kVioKeyframe, channel::kMapFix, channel::kCompass};
  while (const auto event = reader.next()) {
    if (inputs.count(event->channel) == 0) continue;
    bus.publish(event->channel, event->data.data(), static_cast<unsigned>(event->data.size()));
    while (bus.handleTimeout(0) > 0) {
    }
  }
  record.nav.clear();
  for (const nav_state_t& state : heard.states) record.nav.push_back({state.utime, state});
  const evaluate::FusionMetrics m = evaluate::evaluate(record).fusion;
  const Health& health = node.health();
  std::printf("%-22s %6.2f %6.2f %6.2f %7.1f %6.2f %6.2f %6.2f %6.2f %6.2f %6.1f %5.0f %5.0f %4.0f %4d %7.3f\n",
              log.stem().stem().string().c_str(), m.truth.rmse, m.truth.horizontal_rmse, m.truth.vertical_rmse,
              m.truth.largest, m.heading_rmse * 57.29578, m.nees.position, m.nees.horizontal, m.nees.velocity,
              m.nees.attitude, m.time_to_first_fix, health.counter("fixes.used"), health.counter("fixes.outlier"),
              health.counter("fixes.relocked"), m.resets, health.counter("odometry.scale"));
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Fuses recorded flights anew and compares with their truth."};
  std::filesystem::path config;
  std::vector<std::filesystem::path> logs;
  app.add_option("config", config, "folder with fusion.yaml and aircraft.yaml")->required();
  app.add_option("logs", logs, "logs of orthonav-replay")->required();
  CLI11_PARSE(app, argc, argv);
  std::printf("%-22s %6s %6s %6s %7s %6s %6s %6s %6s %6s %6s %5s %5s %4s %4s %7s\n", "flight", "3D", "horiz", "vert",
              "worst", "head", "NEES", "NEES h", "NEES v", "NEES a", "lock s", "used", "outl.", "re.", "rst", "scale");
  for (const std::filesystem::path& log : logs) fuse(config, log);
  return 0;
}
