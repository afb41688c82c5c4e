// The ingest service as a process on a real bus.
#include <filesystem>
#include <fstream>
#include <limits>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "common/bus/channels.h"
#include "common/flightlog/flightlog.h"
#include "orthonav/health_t.hpp"
#include "orthonav/imu_t.hpp"
#include "tests/support/bus_client.h"
#include "tests/support/child_process.h"

namespace orthonav {
namespace {

using test::ChildProcess;
using test::Collector;
using test::handle_until;
namespace fs = std::filesystem;

TEST(IngestProcess, WaitsForServicesThenPlaysALogInOrderWithoutItsBadSamples) {
  const fs::path file = fs::path(testing::TempDir()) / "ingest_process.lcm";
  {
    LogWriter writer(file);
    for (int i = 1; i <= 200; ++i) {
      imu_t imu{};
      imu.utime = 1'000'000 + 5000 * i;
      if (i == 50) imu.specific_force[0] = std::numeric_limits<double>::quiet_NaN();
      if (i == 60) imu.utime -= 100'000;
      writer.write(imu.utime, channel::kImu, imu);
    }
  }
  lcm::LCM bus;
  ASSERT_TRUE(bus.good());
  Collector<imu_t> imu(bus, channel::kImu);
  Collector<health_t> health(bus, channel::kHealth);
  ChildProcess ingest({test::program("orthonav-ingest"), "--config", test::source_tree(), "--log", file, "--speed", "4",
                       "--wait-for", "vio"});
  ASSERT_TRUE(handle_until(bus, [&] { return !health.messages.empty(); }));
  EXPECT_THAT(health.messages[0].service, "ingest");
  ASSERT_TRUE(
      handle_until(bus, [&] { return health.messages.back().message.find("heartbeat of vio") != std::string::npos; }));
  EXPECT_TRUE(imu.messages.empty());

  health_t heartbeat{};
  heartbeat.service = "vio";
  bus.publish(channel::kHealth, &heartbeat);
  ASSERT_TRUE(handle_until(bus, [&] { return imu.messages.size() >= 198; }));
  for (size_t i = 1; i < imu.messages.size(); ++i) EXPECT_LT(imu.messages[i - 1].utime, imu.messages[i].utime);
  EXPECT_EQ(ingest.wait_exit(test::kPatience), 0);
  EXPECT_EQ(imu.messages.size(), 198u) << "the NaN and the sample from the past stay off the bus";
}

TEST(IngestProcess, TerminatesInOrderOnSigterm) {
  const fs::path file = fs::path(testing::TempDir()) / "ingest_sigterm.lcm";
  {
    LogWriter writer(file);
    imu_t imu{};
    imu.utime = 1;
    writer.write(1, channel::kImu, imu);
  }
  lcm::LCM bus;
  Collector<health_t> health(bus, channel::kHealth);
  ChildProcess ingest(
      {test::program("orthonav-ingest"), "--config", test::source_tree(), "--log", file, "--wait-for", "nobody"});
  ASSERT_TRUE(handle_until(bus, [&] { return !health.messages.empty(); }));
  ingest.signal(SIGTERM);
  EXPECT_EQ(ingest.wait_exit(test::kPatience), 0);
}

TEST(IngestProcess, SaysInOneLineWhatIsWrongWithItsArguments) {
  const fs::path output = fs::path(testing::TempDir()) / "ingest_error.txt";
  ChildProcess ingest({test::program("orthonav-ingest"), "--config", test::source_tree()}, output);
  EXPECT_EQ(ingest.wait_exit(test::kPatience), 1);
  std::ifstream stream(output);
  const std::string text((std::istreambuf_iterator<char>(stream)), std::istreambuf_iterator<char>());
  EXPECT_THAT(text, testing::HasSubstr("--log FILE or --asl FOLDER"));
}

}  // namespace
}  // namespace orthonav
