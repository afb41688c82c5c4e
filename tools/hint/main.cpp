// Tells registration where the aircraft is, as far as a person knows: it finds its place sooner, and a wrong word does
// no more than delay it.
#include <chrono>
#include <cmath>
#include <cstdio>
#include <limits>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>
#include <fmt/format.h>

#include "common/bus/channels.h"
#include "common/bus/node.h"
#include "orthonav/health_t.hpp"
#include "orthonav/position_hint_t.hpp"

namespace {

using namespace orthonav;
using std::chrono::milliseconds;

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

void add_corner(position_hint_t& hint, double latitude_deg, double longitude_deg) {
  hint.corner_latitudes_deg.push_back(latitude_deg);
  hint.corner_longitudes_deg.push_back(longitude_deg);
  ++hint.num_corners;
}

double counter_of(const health_t& health, const std::string& name) {
  for (const health_counter_t& counter : health.counters) {
    if (counter.name == name) return counter.value;
  }
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{
      "Tells registration where the aircraft is: a position with a radius, a box, or a polygon. It holds until the "
      "first fix.\n"
      "  orthonav-hint 50.0901 14.4012 --radius 200\n"
      "  orthonav-hint --box 50.085 14.395 50.095 14.410\n"
      "  orthonav-hint --polygon 50.085 14.395 50.095 14.395 50.090 14.410\n"
      "Exit code: 0 registration took it; 1 registration refused it, and says why; 2 no registration answered; 3 no "
      "bus, or not the words of a hint."};
  std::string url, key_file;
  std::vector<double> position, box, polygon;
  double radius = kNan, seconds = 5;
  app.add_option("position", position, "latitude and longitude, degrees, WGS84")->expected(2);
  app.add_option("--radius", radius, "m within which it is with a probability of 95 %");
  app.add_option("--box", box, "south west north east, degrees")->expected(4);
  app.add_option("--polygon", polygon, "latitude and longitude of each corner, in their order, degrees");
  app.add_option("--lcm-url", url, "bus to join (default: LCM_DEFAULT_URL, else this machine only)");
  app.add_option("--bus-key", key_file, "key of the bus's authenticated mode (default: ORTHONAV_BUS_KEY, else none)");
  app.add_option("--seconds", seconds, "how long to wait for registration")
      ->capture_default_str()
      ->check(CLI::Range(1.0, 600.0));
  CLI11_PARSE(app, argc, argv);
  try {
    if ((position.empty() ? 0 : 1) + (box.empty() ? 0 : 1) + (polygon.empty() ? 0 : 1) != 1) {
      throw std::invalid_argument("give a position with --radius, or --box, or --polygon");
    }
    if (position.empty() == (app.count("--radius") > 0)) throw std::invalid_argument("a position has a --radius");
    position_hint_t hint{};
    hint.latitude_deg = hint.longitude_deg = kNan;
    hint.radius = radius;
    if (!position.empty()) {
      hint.latitude_deg = position[0];
      hint.longitude_deg = position[1];
    } else if (!box.empty()) {
      add_corner(hint, box[0], box[1]);
      add_corner(hint, box[0], box[3]);
      add_corner(hint, box[2], box[3]);
      add_corner(hint, box[2], box[1]);
    } else {
      if (polygon.size() % 2 != 0) throw std::invalid_argument("--polygon: a latitude without its longitude");
      for (size_t i = 0; i < polygon.size(); i += 2) add_corner(hint, polygon[i], polygon[i + 1]);
    }
    Node node({.service = "hint", .lcm_url = url, .key_file = key_file, .heartbeat = false});
    int status = 2;
    double received_before = -1, refused_before = 0;
    std::string message;
    node.subscribe<health_t>(channel::kHealth, Delivery::kAll, [&](const health_t& health) {
      if (health.service != "registration") return;
      const double received = counter_of(health, "hints.received"), refused = counter_of(health, "rejected.hint");
      if (received_before < 0) {
        received_before = received;
        refused_before = refused;
        hint.utime = node.now();
        node.publish(channel::kPositionHint, hint);
        return;
      }
      if (received <= received_before) return;
      status = refused > refused_before ? 1 : 0;
      message = health.message;
      node.stop();
    });
    double waited = 0;
    constexpr milliseconds kTick{100};
    node.every(kTick, [&] {
      waited += 1e-3 * static_cast<double>(kTick.count());
      if (waited > seconds) node.stop();
    });
    node.run();
    if (status == 0) fmt::print("registration takes it into account until its first fix\n");
    if (status == 1) fmt::print(stderr, "registration refused it: {}\n", message);
    if (status == 2) fmt::print(stderr, "no registration answered within {} s\n", seconds);
    return status;
  } catch (const std::exception& error) {
    fmt::print(stderr, "orthonav-hint: {}\n", error.what());
    return 3;
  }
}
