// A short flight through all services in one process.
#include "tools/replay/replay.h"

#include <filesystem>
#include <fstream>
#include <limits>
#include <stdexcept>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "common/bus/channels.h"
#include "common/flightlog/flightlog.h"
#include "orthonav/gnss_reference_t.hpp"
#include "orthonav/image_t.hpp"
#include "orthonav/imu_t.hpp"
#include "orthonav/nav_state_t.hpp"
#include "orthonav/truth_t.hpp"
#include "tests/playback/flight_fixture.h"
#include "tests/support/temporary_folder.h"

namespace orthonav {
namespace {

namespace fs = std::filesystem;
using test::flight_folder;

replay::ReplayOptions flight_to(const fs::path& out) {
  replay::ReplayOptions options;
  options.config = test::flight_config();
  options.log = test::flight_log();
  options.map = test::flight_map();
  options.out = out;
  return options;
}

void fly(const fs::path& log, const fs::path& out) {
  auto options = flight_to(out);
  options.log = log;
  replay::replay(options);
}

// The flight as orthonav-replay flew it in make_flight.sh.
fs::path flown() {
  return flight_folder() / "replayed.lcm";
}

std::vector<LogEvent> events_of(const fs::path& log, const std::string& channel) {
  std::vector<LogEvent> events;
  LogReader reader(log);
  while (auto event = reader.next()) {
    if (event->channel == channel) events.push_back(std::move(*event));
  }
  return events;
}

std::vector<nav_state_t> nav_states(const fs::path& log) {
  std::vector<nav_state_t> states;
  for (const auto& event : events_of(log, channel::kNavState)) states.push_back(event.decode<nav_state_t>().value());
  return states;
}

TEST(Replay, FindsItselfOnTheMapFromAnUnknownStart) {
  const auto report = test::evaluate(flown());
  EXPECT_LT(report["fusion"]["rmse_m"].get<double>(), 3.76);
  EXPECT_LT(report["fusion"]["time_to_first_fix_s"].get<double>(), 20.0);
  EXPECT_EQ(report["registration"]["false_fixes"].get<int>(), 0);
}

TEST(Replay, GivesNoGeodeticPositionBeforeTheFirstFixAndOneForEveryFrameAfter) {
  bool fixed = false;
  int before = 0, after = 0;
  for (const auto& state : nav_states(flown())) {
    const bool geodetic = std::isfinite(state.latitude_deg);
    if (state.mode == nav_state_t::MAP_AIDED) fixed = true;
    EXPECT_EQ(geodetic, fixed) << "at " << state.utime;
    ++(fixed ? after : before);
  }
  EXPECT_GT(before, 0);
  EXPECT_GT(after, 300);
}

TEST(Replay, RepeatsBitForBit) {
  const fs::path again = flight_folder() / "again.lcm";
  fly(test::flight_log(), again);
  const auto bytes = [](const fs::path& file) {
    std::ifstream stream(file, std::ios::binary);
    return std::string((std::istreambuf_iterator<char>(stream)), std::istreambuf_iterator<char>());
  };
  EXPECT_TRUE(bytes(flown()) == bytes(again)) << flown() << " and " << again << " differ";
  fs::remove(again);
}

// Without the evaluation's channels the chain must say the very same.
TEST(Replay, TruthDoesNotReachTheChain) {
  const fs::path blind = flight_folder() / "blind.lcm", out = flight_folder() / "blind-out.lcm";
  {
    LogReader reader(test::flight_log());
    LogWriter writer(blind);
    while (const auto event = reader.next()) {
      if (event->channel == channel::kTruth || event->channel == channel::kGnssReference) continue;
      writer.write(event->utime, event->channel, event->data.data(), event->data.size());
    }
  }
  fly(blind, out);
  const auto with = events_of(flown(), channel::kNavState), without = events_of(out, channel::kNavState);
  ASSERT_EQ(with.size(), without.size());
  for (size_t i = 0; i < with.size(); ++i) ASSERT_EQ(with[i].data, without[i].data) << "NAV_STATE number " << i;
  fs::remove(blind);
  fs::remove(out);
}

// One flight with every kind of bad input that a log can carry.
TEST(Replay, BadInputIsSurvivedWithoutLosingThePosition) {
  const fs::path bad = flight_folder() / "bad.lcm", out = flight_folder() / "bad-out.lcm";
  {
    LogReader reader(test::flight_log());
    LogWriter writer(bad);
    int images = 0, samples = 0;
    while (auto event = reader.next()) {
      if (event->channel == channel::kCamera && ++images % 40 == 0) {
        image_t image = event->decode<image_t>().value();
        const int kind = images / 40 % 4;
        if (kind == 0) image.data.resize(image.data.size() / 2);                     // truncated JPEG
        if (kind == 1) std::fill(image.data.begin() + 300, image.data.end(), 0x5A);  // corrupt JPEG
        if (kind == 2) image.data = {1, 2, 3};                                       // no JPEG
        if (kind == 3) image.width = 320;                                            // wrong size
        image.size = static_cast<int32_t>(image.data.size());
        writer.write(event->utime, event->channel, image);
        continue;
      }
      if (event->channel == channel::kImu && ++samples % 500 == 0) {
        imu_t imu = event->decode<imu_t>().value();
        if (samples % 1000 == 0) imu.utime -= 1'000'000;
        imu.angular_rate[0] = std::numeric_limits<double>::quiet_NaN();
        writer.write(event->utime, event->channel, imu);
        writer.write(event->utime, event->channel, "no message", 10);
      }
      writer.write(event->utime, event->channel, event->data.data(), event->data.size());
    }
  }
  fly(bad, out);
  const auto report = test::evaluate(out);
  EXPECT_LT(report["fusion"]["rmse_m"].get<double>(), 3.76);
  fs::remove(bad);
  fs::remove(out);
}

// Seconds from a service's end until positions are map-aided for good.
TEST(Replay, TheSameServicesFlyAgainFromWhereTheyTookOff) {
  const test::TemporaryFolder folder;
  auto options = flight_to(folder / "second.lcm");
  std::vector<replay::LoopSummary> flights;
  options.loops = 2;
  options.landed = [&](const replay::LoopSummary& flight) { flights.push_back(flight); };
  const auto summary = replay::replay(options);
  ASSERT_EQ(flights.size(), 2u);
  EXPECT_NEAR(flights[0].hours * 3600, 60, 0.2);
  EXPECT_NEAR(summary.flight_seconds, 130, 0.4);
  EXPECT_EQ(flights[0].sessions, 1);
  EXPECT_EQ(flights[1].sessions, 2);
  EXPECT_GT(flights[1].aided_percent, 60);
  EXPECT_GT(flights[1].cpu_ms, 0);
  EXPECT_LT(flights[1].resident_mb, 1.2 * flights[0].resident_mb);
  // The log is the second flight's alone.
  const auto images = events_of(folder / "second.lcm", channel::kCamera);
  EXPECT_EQ(images.size(), events_of(test::flight_log(), channel::kCamera).size());
  const auto report = test::evaluate(folder / "second.lcm");
  EXPECT_EQ(report["registration"]["false_fixes"].get<int>(), 0);
  EXPECT_LT(report["fusion"]["rmse_m"].get<double>(), 3.76);
}

struct Recovery {
  double seconds = 0;
  int resets = 0;
  double rmse = 0;  // m, over the flight
};

Recovery kill(const std::string& service, double at) {
  const test::TemporaryFolder folder;
  const fs::path out = folder / "killed.lcm", memory = folder / "memory";
  auto options = flight_to(out);
  options.memory = memory;
  options.restarts = {{.service = service, .at = at}};
  replay::replay(options);
  Recovery recovery;
  int64_t killed = 0;
  int counter = 0;
  for (const auto& event : events_of(out, channel::kNavState)) {
    const auto state = event.decode<nav_state_t>().value();
    if (killed == 0) killed = state.utime + static_cast<int64_t>(1e6 * at);
    if (event.utime <= killed) {
      counter = state.reset_counter;
    } else {
      if (state.mode != nav_state_t::MAP_AIDED) recovery.seconds = 1e-6 * static_cast<double>(event.utime - killed);
      recovery.resets = state.reset_counter - counter;
    }
  }
  recovery.rmse = test::evaluate(out)["fusion"]["rmse_m"].get<double>();
  return recovery;
}

TEST(KilledInAReplay, TheFusionIsMapAidedWithinTwoSecondsOfItsRestartWithoutAReset) {
  for (const double at : {16.0, 25.0, 38.3}) {
    const Recovery recovery = kill("fusion", at);
    EXPECT_LT(recovery.seconds, 2.5) << at;
    EXPECT_EQ(recovery.resets, 0) << at;
    EXPECT_LT(recovery.rmse, 3.76);
  }
}

TEST(KilledInAReplay, TheOdometryIsMapAidedWithinFiveSecondsOfItsRestartWithoutAReset) {
  for (const double at : {20.0, 25.0}) {
    const Recovery recovery = kill("vio", at);
    EXPECT_LT(recovery.seconds, 5.5) << at;
    EXPECT_EQ(recovery.resets, 0) << at;
    EXPECT_LT(recovery.rmse, 3.76);
  }
}

TEST(KilledInAReplay, RegistrationAndItsMapServerAreNotMissed) {
  for (const char* service : {"registration", "map_server"}) {
    const Recovery recovery = kill(service, 25.0);
    EXPECT_EQ(recovery.seconds, 0.0) << service;
    EXPECT_EQ(recovery.resets, 0) << service;
  }
}

TEST(KilledInAReplay, AServiceThatIsNoneIsAnErrorThatNamesIt) {
  try {
    kill("autopilot", 1.0);
    FAIL();
  } catch (const std::runtime_error& error) {
    EXPECT_NE(std::string(error.what()).find("autopilot"), std::string::npos);
  }
}

}  // namespace
}  // namespace orthonav
