#include "tools/status/fleet.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

namespace orthonav::status {
namespace {

using testing::HasSubstr;

health_t heartbeat(const std::string& service, double uptime, int8_t state,
                   const std::map<std::string, double>& counters = {}) {
  health_t h;
  h.utime = 1;
  h.service = service;
  h.host = "board1";
  h.version = "0.1.0";
  h.pid = 7;
  h.state = state;
  h.message = state == health_t::OK ? "" : "why";
  h.uptime = uptime;
  for (const auto& [name, value] : counters) {
    health_counter_t c;
    c.name = name;
    c.value = value;
    h.counters.push_back(c);
  }
  h.num_counters = static_cast<int32_t>(h.counters.size());
  return h;
}

TEST(Fleet, RatesAreDifferencesOfTwoHeartbeats) {
  Fleet fleet({});
  fleet.add(heartbeat("vio", 10, health_t::OK, {{"received.IMU", 1000}, {"published.VIO_STATE", 50}}), 1);
  fleet.add(heartbeat("vio", 12, health_t::OK,
                      {{"received.IMU", 1400},
                       {"received.CAMERA", 20},
                       {"published.VIO_STATE", 70},
                       {"rejected.camera", 4},
                       {"latency_ms.IMU", 0.2},
                       {"latency_ms.CAMERA", 31},
                       {"cpu.percent", 42},
                       {"memory.bytes", 123e6},
                       {"clock.skew_ms.board2", -12}}),
            2'000'001);
  const Row row = fleet.rows(2'000'001).at(0);
  EXPECT_DOUBLE_EQ(row.in_hz, 210);
  EXPECT_DOUBLE_EQ(row.out_hz, 10);
  EXPECT_DOUBLE_EQ(row.rejected, 4);
  EXPECT_DOUBLE_EQ(row.rejected_hz, 2);
  EXPECT_DOUBLE_EQ(row.latency_ms, 31);
  EXPECT_DOUBLE_EQ(row.cpu_percent, 42);
  EXPECT_DOUBLE_EQ(row.memory_mb, 123);
  EXPECT_DOUBLE_EQ(row.skew_ms, -12);
}

TEST(Fleet, ARestartedServiceCountsAnew) {
  Fleet fleet({});
  fleet.add(heartbeat("vio", 10, health_t::OK, {{"received.IMU", 1000}}), 1);
  fleet.add(heartbeat("vio", 1, health_t::OK, {{"received.IMU", 5}}), 2);
  EXPECT_EQ(fleet.rows(2).at(0).in_hz, 0);
}

TEST(Fleet, TheVerdictIsThatOfTheWorstService) {
  Fleet fleet({"vio"});
  EXPECT_EQ(fleet.verdict(0), Verdict::kBad) << "nobody is there";
  fleet.add(heartbeat("vio", 1, health_t::OK), 1);
  EXPECT_EQ(fleet.verdict(1), Verdict::kOk);
  fleet.add(heartbeat("fusion", 1, health_t::STARTING), 1);
  EXPECT_EQ(fleet.verdict(1), Verdict::kNotReady);
  fleet.add(heartbeat("ingest", 1, health_t::FAILED), 1);
  EXPECT_EQ(fleet.verdict(1), Verdict::kBad);
}

TEST(Fleet, ASilentServiceIsLostAndAnAbsentOneMissing) {
  Fleet fleet({"vio", "fusion"});
  fleet.add(heartbeat("vio", 1, health_t::OK), 1);
  const auto rows = fleet.rows(4'000'000);
  ASSERT_EQ(rows.size(), 2u);
  EXPECT_EQ(rows[0].state, "LOST");
  EXPECT_EQ(rows[1].service, "fusion");
  EXPECT_EQ(rows[1].state, "MISSING");
}

TEST(Fleet, ANameFromTheBusCannotCommandTheTerminal) {
  Fleet fleet({});
  fleet.add(heartbeat("evil\033[2J\n", 1, health_t::OK), 1);
  const std::string text = to_text(fleet.rows(1), false);
  EXPECT_THAT(text, testing::Not(HasSubstr("\033")));
  EXPECT_EQ(std::count(text.begin(), text.end(), '\n'), 2);
}

}  // namespace
}  // namespace orthonav::status
