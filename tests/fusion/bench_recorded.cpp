// Fuses recorded flights anew, from their VIO_STATE, VIO_KEYFRAME, MAP_FIX and COMPASS: what a parameter does, in
// seconds instead of a replay's minutes.
//   bench_recorded CONFIG_FOLDER OUT.lcm...      (logs that orthonav-replay wrote)
//   --map FLIGHT.map.tif: of one flight; it is registered anew, too
//   --out NEW.lcm: of one flight, what was said and the truth to compare it with, without the images
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>
#include <lcm/lcm-cpp.hpp>

#include "common/bus/channels.h"
#include "common/flightlog/flightlog.h"
#include "orthonav/compass_t.hpp"
#include "services/fusion/fusion_service.h"
#include "services/map_server/map_server_service.h"
#include "services/registration/registration_service.h"
#include "tools/evaluate/flight_record.h"
#include "tools/evaluate/metrics.h"

using namespace orthonav;

namespace {

struct Arguments {
  std::filesystem::path config, map, out;
  std::vector<std::filesystem::path> logs;
};

// What the services of this run say.
struct Listener {
  std::optional<LogWriter> log;
  std::vector<evaluate::Logged<nav_state_t>> states;
  std::vector<map_fix_t> fixes;
  int64_t utime = 0;

  void write(const lcm::ReceiveBuffer* buffer, const std::string& channel) {
    if (log && channel != channel::kCamera) log->write(utime, channel, buffer->data, buffer->data_size);
  }
  void hear_state(const lcm::ReceiveBuffer* /*buffer*/, const std::string& /*channel*/, const nav_state_t* m) {
    if (m->source == nav_state_t::FRAME) states.push_back({m->utime, *m});
  }
  void hear_fix(const lcm::ReceiveBuffer* /*buffer*/, const std::string& /*channel*/, const map_fix_t* m) {
    fixes.push_back(*m);
  }
};

void print(const std::string& name, const evaluate::Metrics& metrics, const Health& health) {
  const evaluate::FusionMetrics& m = metrics.fusion;
  const evaluate::PositionErrors& fixes = metrics.registration.truth;
  const evaluate::ProtectionStatistics& level = m.protection;
  std::printf(
      "%-22s %6.2f %6.2f %6.2f | %6.2f %6.2f %6.2f %7.1f %6.2f %6.2f %6.2f %6.2f %6.2f | %5.1f%% %6.2f %6.2f %5d | "
      "%6.1f "
      "%5.0f %5.0f %4.0f %4d %7.3f\n",
      name.c_str(), fixes.rmse, fixes.horizontal_rmse, fixes.vertical_rmse, m.truth.rmse, m.truth.horizontal_rmse,
      m.truth.vertical_rmse, m.truth.largest, m.heading_rmse * 57.29578, m.nees.position, m.nees.horizontal,
      m.nees.velocity, m.nees.attitude, 100.0 * level.bounded / std::max(1, level.epochs), level.horizontal_median,
      level.vertical_median, level.misleading_horizontal + level.misleading_vertical, m.time_to_first_fix,
      health.counter("fixes.used"), health.counter("fixes.outlier"), health.counter("fixes.relocked"), m.resets,
      health.counter("odometry.scale"));
}

void fuse(const Arguments& arguments, const std::filesystem::path& file) {
  evaluate::FlightRecord record = evaluate::FlightRecord::read(file);
  lcm::LCM bus("memq://");
  Listener heard;
  if (!arguments.out.empty()) heard.log.emplace(arguments.out);
  bus.subscribe(".*", &Listener::write, &heard)->setQueueCapacity(0);
  bus.subscribe(channel::kNavState, &Listener::hear_state, &heard)->setQueueCapacity(0);
  bus.subscribe(channel::kMapFix, &Listener::hear_fix, &heard)->setQueueCapacity(0);
  std::set<std::string> inputs{channel::kVioState, channel::kVioKeyframe, channel::kCompass, channel::kTruth};
  Node fusion_node({.service = "fusion"}, bus), map_node({.service = "map_server"}, bus),
      registration_node({.service = "registration"}, bus);
  std::optional<map_server::MapServerService> map_server;
  std::optional<registration::RegistrationService> registration;
  if (arguments.map.empty()) {
    inputs.insert(channel::kMapFix);
  } else {
    inputs.insert(channel::kCamera);
    map_server.emplace(map_node, arguments.config, arguments.map);
    registration.emplace(registration_node, arguments.config);
  }
  fusion::FusionService fusion(fusion_node, arguments.config);
  LogReader reader(file);
  while (const auto event = reader.next()) {
    heard.utime = event->utime;
    for (Node* node : {&map_node, &registration_node}) {
      if (registration) node->advance(event->utime);
    }
    if (inputs.count(event->channel) > 0) {
      bus.publish(event->channel, event->data.data(), static_cast<unsigned>(event->data.size()));
    }
    while (bus.handleTimeout(0) > 0) {
    }
  }
  record.nav = heard.states;
  record.fixes = heard.fixes;
  print(file.stem().stem().string(), evaluate::evaluate(record), fusion_node.health());
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Fuses recorded flights anew and compares with their truth."};
  Arguments arguments;
  app.add_option("config", arguments.config, "folder with fusion.yaml and aircraft.yaml")->required();
  app.add_option("logs", arguments.logs, "logs of orthonav-replay")->required();
  app.add_option("--map", arguments.map, "of one flight: it is registered anew, too")->check(CLI::ExistingFile);
  app.add_option("--out", arguments.out, "log to write of one flight, without its images");
  CLI11_PARSE(app, argc, argv);
  if (arguments.logs.size() > 1 && !(arguments.map.empty() && arguments.out.empty())) {
    std::fprintf(stderr, "--map and --out are of one flight, and there are %zu logs\n", arguments.logs.size());
    return 1;
  }
  std::printf("%-22s %20s | %57s | %26s |\n", "", "fixes", "fusion", "protection levels");
  std::printf("%-22s %6s %6s %6s | %6s %6s %6s %7s %6s %6s %6s %6s %6s | %6s %6s %6s %5s | %6s %5s %5s %4s %4s %7s\n",
              "flight", "3D", "horiz", "vert", "3D", "horiz", "vert", "worst", "head", "NEES", "NEES h", "NEES v",
              "NEES a", "with", "horiz", "vert", "misl.", "lock s", "used", "outl.", "re.", "rst", "scale");
  for (const std::filesystem::path& log : arguments.logs) fuse(arguments, log);
  return 0;
}
