// The chain spread over three boards, network namespaces joined by a bridge (deploy/fly-boards): what it costs against
// one board, with packets lost and with cables pulled. tools/benchmark/boards prints the whole table.
#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "common/bus/channels.h"
#include "common/flightlog/flightlog.h"
#include "orthonav/health_t.hpp"
#include "tests/playback/flight_fixture.h"
#include "tests/support/child_process.h"
#include "tests/support/flight_speed.h"
#include "tests/support/temporary_folder.h"

namespace orthonav {
namespace {

using namespace std::chrono_literals;
using test::ChildProcess;
using Report = nlohmann::json;

// What fly-boards ends with where network namespaces are refused, and ctest is told.
constexpr int kNotPermitted = 77;

// What a service says in a recorded log of a sensors' channel that is silent.
struct Silence {
  double said_after_s = -1;  // since the last compass reading before, s; negative: it does not say so
  bool ended = false;        // later it says nothing of the kind
};

Silence silence_of(const std::filesystem::path& log, const std::string& service) {
  Silence silence;
  int64_t last_reading = 0;
  LogReader reader(log);
  while (const auto event = reader.next()) {
    if (event->channel == channel::kCompass) last_reading = event->utime;
    health_t health;
    if (event->channel != channel::kHealth ||
        health.decode(event->data.data(), 0, static_cast<int>(event->data.size())) < 0 || health.service != service) {
      continue;
    }
    const bool says_so =
        health.state >= health_t::DEGRADED && health.message.find("COMPASS: silent for") != std::string::npos;
    const double silent = 1e-6 * static_cast<double>(event->utime - last_reading);
    if (says_so && silence.said_after_s < 0 && silent > 1.9) silence.said_after_s = silent;
    if (!says_so && silence.said_after_s >= 0) silence.ended = true;
  }
  return silence;
}

class BoardsFlight : public testing::Test {
 protected:
  // Begins a flight over the boards of deploy/boards/`boards`.yaml; flights fly beside each other, each on a bus of its
  // own.
  void begin(const std::string& name, const std::string& boards, const std::vector<std::string>& more = {}) {
    const auto deploy = test::source_tree() / "deploy";
    std::vector<std::string> arguments{deploy / "fly-boards",
                                       deploy / "boards" / (boards + ".yaml"),
                                       test::flight_config(),
                                       test::flight_log(),
                                       test::flight_map(),
                                       folder_ / (name + ".lcm"),
                                       "--speed",
                                       test::flight_speed()};
    arguments.insert(arguments.end(), more.begin(), more.end());
    flights_[name] = std::make_unique<ChildProcess>(arguments, folder_ / (name + ".txt"));
  }
  // What orthonav-evaluate says of the flight, once it has landed.
  Report land(const std::string& name) {
    const auto status = flights_.at(name)->wait_exit(test::flown(150s));
    if (status == kNotPermitted) std::exit(kNotPermitted);
    EXPECT_EQ(status, 0) << name;
    return test::evaluate(folder_ / (name + ".lcm"));
  }
  static double rmse(const Report& report) { return report["fusion"]["rmse_m"]; }
  static double counter(const Report& report, const std::string& service, const std::string& name) {
    return report["health"][service]["counters"].value(name, 0.0);
  }
  // The same flight through all services in one process.
  static Report replayed() { return test::evaluate(test::flight_folder() / "replayed.lcm"); }

  test::TemporaryFolder folder_;

 private:
  std::map<std::string, std::unique_ptr<ChildProcess>> flights_;
};

TEST_F(BoardsFlight, TwoAndThreeBoardsFlyAsOneDoes) {
  for (const char* boards : {"one", "two", "three"}) begin(boards, boards);
  const Report one = land("one"), two = land("two"), three = land("three");
  for (const Report* more : {&two, &three}) {
    EXPECT_NEAR(rmse(*more), rmse(one), 0.1 * rmse(one));
    EXPECT_EQ((*more)["registration"]["false_fixes"], 0);
    EXPECT_GE((*more)["registration"]["fixes"].get<double>(), 0.9 * one["registration"]["fixes"].get<double>());
  }
  // Each of the other boards' clocks is compared with the fusion's; here they are one.
  for (const char* board : {"eyes", "atlas"}) {
    const Report counters = three["health"]["fusion"]["counters"];
    const std::string skew = std::string("clock.skew_ms.") + board;
    ASSERT_TRUE(counters.contains(skew)) << board;
    EXPECT_LT(std::abs(counters[skew].get<double>()), 50) << board;
  }
}

TEST_F(BoardsFlight, PacketsLostOnASealedBusCostNeitherFixesNorThePosition) {
  const auto key = folder_ / "bus.key";
  std::ofstream(key) << std::string(64, '5');
  std::filesystem::permissions(key, std::filesystem::perms::owner_read);
  setenv("ORTHONAV_BUS_KEY", key.c_str(), 1);
  begin("per mille", "three", {"--loss", "1"});
  begin("per cent", "three", {"--loss", "10"});
  unsetenv("ORTHONAV_BUS_KEY");
  const Report clean = replayed();
  for (const char* name : {"per mille", "per cent"}) {
    const Report report = land(name);
    EXPECT_LT(rmse(report), 1.25 * rmse(clean)) << name;
    EXPECT_EQ(report["registration"]["false_fixes"], 0) << name;
    // The whole map is there, whatever part of it was lost: it was asked for again.
    EXPECT_GT(counter(report, "map_server", "map.features"), 0) << name;
    EXPECT_EQ(counter(report, "registration", "map.features"), counter(report, "map_server", "map.features")) << name;
    if (name != std::string("per cent")) continue;
    EXPECT_GT(counter(report, "registration", "map.parts_asked_again"), 0);
    const double images =
        counter(report, "registration", "received.CAMERA") / counter(report, "ingest", "published.CAMERA");
    const double keyframes = report["health"]["vio"]["counters"]["keyframes"];
    EXPECT_LT(images, 0.75);
    EXPECT_LE(counter(report, "fusion", "keyframes.missed"), 0.05 * keyframes);
    // Of the images on CAMERA half are lost; of their parts, which come twice, next to none.
    EXPECT_LE(counter(report, "registration", "rejected.keyframe.no_image"), 0.05 * keyframes);
    EXPECT_GE(report["registration"]["fixes"].get<double>(), 0.9 * clean["registration"]["fixes"].get<double>());
    EXPECT_GT(counter(report, "vio", "rejected.camera.missed"), 0);
  }
}

TEST_F(BoardsFlight, ACablePulledForTenSecondsIsSurvived) {
  begin("odometry's", "three", {"--cut", "eyes:25:10"});
  begin("map server's", "three", {"--cut", "atlas:5:10"});
  const double clean = rmse(replayed());
  const Report odometry = land("odometry's"), map_server = land("map server's");
  EXPECT_GT(odometry["lost"]["keyframe_ids_missing"], 0);  // it was pulled
  for (const Report* report : {&odometry, &map_server}) {
    EXPECT_LT(rmse(*report), 1.25 * clean);
    EXPECT_EQ((*report)["registration"]["false_fixes"], 0);
    EXPECT_EQ((*report)["vio"]["restarts"], 0);
  }
  // Who is cut off from the odometry's board says so, in two seconds and a heartbeat, and flies on.
  for (const char* service : {"fusion", "registration"}) {
    const Silence silence = silence_of(folder_ / "odometry's.lcm", service);
    EXPECT_GE(silence.said_after_s, 0) << service;
    EXPECT_LE(silence.said_after_s, 5) << service;
    EXPECT_TRUE(silence.ended) << service;
  }
}

}  // namespace
}  // namespace orthonav
