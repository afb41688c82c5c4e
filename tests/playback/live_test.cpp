// The same short flight through five processes over UDP multicast, in real time (instrumented: slower).
#include <filesystem>
#include <fstream>
#include <map>
#include <set>
#include <thread>

#include <gtest/gtest.h>

#include "common/bus/channels.h"
#include "common/flightlog/flightlog.h"
#include "common/geo/enu_frame.h"
#include "orthonav/health_t.hpp"
#include "orthonav/map_fix_t.hpp"
#include "orthonav/nav_state_t.hpp"
#include "orthonav/vio_state_t.hpp"
#include "tests/playback/flight_fixture.h"
#include "tests/support/bus_client.h"
#include "tests/support/flight_speed.h"
#include "tests/support/temporary_folder.h"

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
  // As the units start them.
  Arguments options_of(const std::string& service) const {
    if (service == "map-server") return {"--map", test::flight_map()};
    if (service == "registration") return {};
    return {"--memory", memory_ / service};
  }
  std::map<std::string, std::unique_ptr<ChildProcess>> start_all() const {
    std::map<std::string, std::unique_ptr<ChildProcess>> services;
    for (const char* name : {"map-server", "registration", "fusion", "vio"})
      services[name] = start(name, options_of(name));
    return services;
  }
  std::unique_ptr<ChildProcess> start_ingest() const {
    return start("ingest", {"--log", test::flight_log(), "--speed", test::flight_speed(), "--wait-for",
                            "vio,map_server,registration,fusion"});
  }
  // Of a log, by utime.
  static std::map<int64_t, map_fix_t> valid_fixes(const fs::path& log) {
    std::map<int64_t, map_fix_t> fixes;
    LogReader reader(log);
    while (const auto event = reader.next()) {
      if (event->channel != channel::kMapFix) continue;
      const auto fix = event->decode<map_fix_t>();
      if (fix && fix->valid) fixes[fix->utime] = *fix;
    }
    return fixes;
  }

  test::TemporaryFolder memory_;
};

TEST_F(LiveFlight, FiveProcessesReachTheReplaysAccuracyAndStopInOrder) {
  const fs::path out = test::flight_folder() / "live.lcm";
  ChildProcess fly({test::source_tree() / "deploy" / "fly", test::flight_config(), test::flight_log(),
                    test::flight_map(), out, test::flight_speed()},
                   test::flight_folder() / "live-fly.txt");
  ASSERT_EQ(fly.wait_exit(test::flown(150s)), 0);
  const auto report = test::evaluate(out);
  EXPECT_LT(report["fusion"]["rmse_m"].get<double>(), 3.76);

  // What lcm-logger recorded of it, played by lcm-logplayer to services that have just started, gives the same fixes.
  const auto recorded = valid_fixes(out);
  ASSERT_GT(recorded.size(), 30u);
  lcm::LCM bus;
  ASSERT_TRUE(bus.good());
  Collector<map_fix_t> fixes(bus, channel::kMapFix);
  Collector<health_t> heartbeats(bus, channel::kHealth);
  const auto services = start_all();
  const auto all_there = [&] {
    std::set<std::string> there;
    for (const auto& message : heartbeats.messages) there.insert(message.service);
    return there.size() == services.size();
  };
  ASSERT_TRUE(handle_until(bus, all_there));
  // At the recording's own pace, which is that of the flight it is of.
  ChildProcess player({"/usr/bin/lcm-logplayer", "--regexp=^(IMU|CAMERA|COMPASS)$", out},
                      test::flight_folder() / "live-player.txt");
  ASSERT_TRUE(handle_until(
      bus, [&] { return !player.running(); }, test::flown(100s)));
  handle_until(
      bus, [&] { return !fixes.messages.empty() && fixes.messages.back().utime >= recorded.rbegin()->first; }, 5s);
  size_t played = 0, same = 0;
  for (const map_fix_t& fix : fixes.messages) {
    if (!fix.valid) continue;
    ++played;
    const auto it = recorded.find(fix.utime);
    if (it == recorded.end()) continue;
    const EnuFrame frame({it->second.latitude_deg, it->second.longitude_deg, it->second.ellipsoidal_height});
    if (frame.to_enu({fix.latitude_deg, fix.longitude_deg, fix.ellipsoidal_height}).norm() < 1) ++same;
  }
  EXPECT_GE(static_cast<double>(same), 0.8 * static_cast<double>(recorded.size())) << played << " fixes";
}

TEST_F(LiveFlight, AnyServiceKilledIsNavigatingAgainWithinFiveSecondsAndTheOthersStay) {
  lcm::LCM bus;
  ASSERT_TRUE(bus.good());
  Collector<nav_state_t> nav(bus, channel::kNavState);
  Collector<map_fix_t> fixes(bus, channel::kMapFix);
  auto services = start_all();
  const auto ingest = start_ingest();
  const auto aided = [&] { return !nav.messages.empty() && nav.messages.back().mode == nav_state_t::MAP_AIDED; };
  const auto fixed = [&] { return !fixes.messages.empty() && fixes.messages.back().valid; };
  ASSERT_TRUE(handle_until(
      bus, [&] { return aided() && fixed(); }, test::flown(40s)));

  for (const char* killed : {"map-server", "registration", "fusion", "vio"}) {
    const nav_state_t before = nav.messages.back();
    services.at(killed)->signal(SIGKILL);
    ASSERT_EQ(services.at(killed)->wait_exit(5s), 128 + SIGKILL);
    services.at(killed) = start(killed, options_of(killed));
    nav.messages.clear();
    fixes.messages.clear();
    // A new odometry world: fusion must not tie it to the old one.
    const auto navigating = [&] {
      return aided() && (killed != std::string("vio") || nav.messages.back().session != before.session);
    };
    EXPECT_TRUE(handle_until(bus, navigating, test::flown(5s))) << killed;
    EXPECT_TRUE(handle_until(bus, fixed, test::flown(10s))) << killed;
    EXPECT_EQ(nav.messages.back().reset_counter, before.reset_counter) << killed;
    for (const auto& [name, service] : services) EXPECT_TRUE(service->running()) << name << " after " << killed;
  }

  // Garbage on every channel is no reason to stop either.
  const std::string garbage(300, 'x');
  for (const char* channel :
       {channel::kImu, channel::kCamera, channel::kCompass, channel::kVioState, channel::kVioKeyframe,
        channel::kKeyframeImage, channel::kMapInfo, channel::kMapTile, channel::kMapTileRequest, channel::kMapFix,
        channel::kNavState, channel::kVioReset, channel::kPositionHint, channel::kPlaceHypotheses, channel::kHealth}) {
    for (int i = 0; i < 100; ++i) bus.publish(channel, garbage.data(), static_cast<unsigned>(garbage.size()));
  }
  const size_t count = nav.messages.size();
  EXPECT_TRUE(handle_until(
      bus, [&] { return nav.messages.size() > count + 20 && aided(); }, test::flown(20s)));
  for (const auto& [name, service] : services) {
    EXPECT_TRUE(service->running()) << name;
    service->signal(SIGTERM);
    EXPECT_EQ(service->wait_exit(10s), 0) << name;
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

TEST_F(LiveFlight, RegistrationTakesAPersonsHint) {
  lcm::LCM bus;
  ASSERT_TRUE(bus.good());
  const auto hint = [](const std::vector<std::string>& arguments) {
    std::vector<std::string> command{test::program("orthonav-hint")};
    command.insert(command.end(), arguments.begin(), arguments.end());
    ChildProcess process(command, test::flight_folder() / "hint.txt");
    return process.wait_exit(20s);
  };
  auto registration = start("registration");
  Collector<health_t> heartbeats(bus, channel::kHealth);
  ASSERT_TRUE(handle_until(
      bus, [&] { return !heartbeats.messages.empty(); }, 20s));
  EXPECT_EQ(hint({"48.1", "11.5", "--radius", "300"}), 0);
  EXPECT_EQ(hint({"--box", "48", "11", "48.1", "11.1"}), 0);
  EXPECT_EQ(hint({"--polygon", "48", "11", "48.1", "11", "48.1", "11.1"}), 0);
  EXPECT_EQ(hint({"-29.2", "-51.9", "--radius", "300"}), 0);
  EXPECT_EQ(hint({"48.1", "11.5", "--radius", "1e9"}), 1) << "as large as the Earth";
  EXPECT_EQ(hint({"98.1", "11.5", "--radius", "300"}), 1);
  EXPECT_EQ(hint({"48.1", "11.5"}), 3) << "no radius";
  EXPECT_EQ(hint({}), 3);
  registration->signal(SIGTERM);
  EXPECT_EQ(registration->wait_exit(10s), 0);
  EXPECT_EQ(hint({"48.1", "11.5", "--radius", "300"}), 2);
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
