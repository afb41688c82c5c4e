// The same short flight through five processes over UDP multicast, in real time (instrumented: slower).
#include <filesystem>
#include <fstream>
#include <thread>

#include <gtest/gtest.h>

#include "common/bus/channels.h"
#include "orthonav/health_t.hpp"
#include "orthonav/map_fix_t.hpp"
#include "orthonav/nav_state_t.hpp"
#include "orthonav/vio_state_t.hpp"
#include "tests/playback/flight_fixture.h"
#include "tests/support/bus_client.h"
#include "tests/support/flight_speed.h"

namespace orthonav {
namespace {

using namespace std::chrono_literals;
using test::ChildProcess;
using test::Collector;
using test::handle_until;
namespace fs = std::filesystem;

class LiveFlight : public testing::Test {
 protected:
  using Arguments = std::vector<std::string>;

  std::unique_ptr<ChildProcess> start(const std::string& service, Arguments more = {}) const {
    Arguments arguments{test::program("orthonav-" + service), "--config", test::flight_config()};
    arguments.insert(arguments.end(), more.begin(), more.end());
    return std::make_unique<ChildProcess>(arguments, test::flight_folder() / ("live-" + service + ".txt"));
  }
  std::unique_ptr<ChildProcess> start_ingest() const {
    return start("ingest", {"--log", test::flight_log(), "--speed", test::flight_speed(), "--wait-for",
                            "vio,map_server,registration,fusion"});
  }
};

TEST_F(LiveFlight, FiveProcessesReachTheReplaysAccuracyAndStopInOrder) {
  const fs::path out = test::flight_folder() / "live.lcm";
  ChildProcess fly({test::source_tree() / "deploy" / "fly", test::flight_config(), test::flight_log(),
                    test::flight_map(), out, test::flight_speed()},
                   test::flight_folder() / "live-fly.txt");
  ASSERT_EQ(fly.wait_exit(test::flown(150s)), 0);
  const auto report = test::evaluate(out);
  EXPECT_LT(report["fusion"]["rmse_m"].get<double>(), 3.76);
}

TEST_F(LiveFlight, AServiceKilledInFlightComesBackAndTheOthersStay) {
  lcm::LCM bus;
  ASSERT_TRUE(bus.good());
  Collector<nav_state_t> nav(bus, channel::kNavState);
  auto map_server = start("map-server", {"--map", test::flight_map()});
  auto registration = start("registration");
  auto fusion = start("fusion");
  auto vio = start("vio");
  auto ingest = start_ingest();
  const auto aided = [&] { return !nav.messages.empty() && nav.messages.back().mode == nav_state_t::MAP_AIDED; };
  ASSERT_TRUE(handle_until(bus, aided, test::flown(40s)));

  vio->signal(SIGKILL);
  ASSERT_EQ(vio->wait_exit(5s), 128 + SIGKILL);
  const int32_t session = nav.messages.back().session;
  vio = start("vio");
  // A new odometry world: fusion must not tie it to the old one, and must find itself anew.
  Collector<map_fix_t> fixes(bus, channel::kMapFix);
  const auto found = [&] {
    return !fixes.messages.empty() && fixes.messages.back().valid && fixes.messages.back().session != session;
  };
  EXPECT_TRUE(handle_until(
      bus, [&] { return found() && aided() && nav.messages.back().session != session; }, test::flown(30s)));
  EXPECT_TRUE(map_server->running());
  EXPECT_TRUE(registration->running());
  EXPECT_TRUE(fusion->running());

  // Garbage on every channel is no reason to stop either.
  const std::string garbage(300, 'x');
  for (const char* channel :
       {channel::kImu, channel::kCamera, channel::kCompass, channel::kVioState, channel::kVioKeyframe,
        channel::kMapInfo, channel::kMapTile, channel::kMapTileRequest, channel::kMapFix, channel::kHealth}) {
    for (int i = 0; i < 100; ++i) bus.publish(channel, garbage.data(), static_cast<unsigned>(garbage.size()));
  }
  const size_t count = nav.messages.size();
  EXPECT_TRUE(handle_until(
      bus, [&] { return nav.messages.size() > count + 20 && aided(); }, test::flown(20s)));
  for (auto* service : {&map_server, &registration, &fusion, &vio}) {
    EXPECT_TRUE((*service)->running());
    (*service)->signal(SIGTERM);
    EXPECT_EQ((*service)->wait_exit(10s), 0);
  }
}

TEST_F(LiveFlight, TheOdometryBeginsAnewOnRequest) {
  lcm::LCM bus;
  ASSERT_TRUE(bus.good());
  Collector<vio_state_t> states(bus, channel::kVioState);
  auto vio = start("vio");
  auto ingest = start("ingest", {"--log", test::flight_log(), "--speed", test::flight_speed(), "--wait-for", "vio"});
  const auto flies = [&] { return !states.messages.empty() && states.messages.back().status == vio_state_t::TRACKING; };
  ASSERT_TRUE(handle_until(bus, flies, test::flown(40s)));
  const int32_t session = states.messages.back().session;
  ChildProcess reset({test::program("orthonav-reset"), "--reason", "a test"}, test::flight_folder() / "reset.txt");
  EXPECT_TRUE(handle_until(
      bus, [&] { return flies() && states.messages.back().session == session + 1; }, test::flown(20s)));
  EXPECT_EQ(reset.wait_exit(5s), 0);
  // Nobody is asked: the program says so.
  vio->signal(SIGTERM);
  EXPECT_EQ(vio->wait_exit(10s), 0);
  ChildProcess unheard({test::program("orthonav-reset")}, test::flight_folder() / "reset.txt");
  EXPECT_EQ(unheard.wait_exit(10s), 2);
}

TEST_F(LiveFlight, AMisspeltKeyEndsAServiceWithFileAndLine) {
  const fs::path folder = fs::path(testing::TempDir()) / "misspelt";
  fs::create_directories(folder);
  for (const char* service : {"vio", "registration", "fusion", "map-server"}) {
    std::string file = service;
    std::replace(file.begin(), file.end(), '-', '_');
    for (const char* copied : {"aircraft", "vio", "registration", "fusion", "map_server"}) {
      std::ofstream(folder / (std::string(copied) + ".yaml"))
          << "extends: " << (test::flight_config() / (std::string(copied) + ".yaml")).string() << "\n";
    }
    std::ofstream(folder / (file + ".yaml"), std::ios::app) << "misspelt_key: 1\n";
    const fs::path output = folder / (file + ".txt");
    ChildProcess process(
        {test::program("orthonav-" + std::string(service)), "--config", folder, "--lcm-url", "memq://"}, output);
    EXPECT_EQ(process.wait_exit(20s), 1) << service;
    std::ifstream stream(output);
    const std::string text((std::istreambuf_iterator<char>(stream)), std::istreambuf_iterator<char>());
    EXPECT_NE(text.find(file + ".yaml:2"), std::string::npos) << text;
    EXPECT_NE(text.find("misspelt_key"), std::string::npos) << text;
  }
}

}  // namespace
}  // namespace orthonav
