// From a recorded turn to headings on the bus: orthonav-calibrate-compass, then orthonav-ingest.
#include <cmath>
#include <filesystem>
#include <fstream>

#include <gtest/gtest.h>

#include "common/bus/channels.h"
#include "common/flightlog/flightlog.h"
#include "orthonav/compass_t.hpp"
#include "orthonav/imu_t.hpp"
#include "orthonav/magnetometer_t.hpp"
#include "tests/support/bus_client.h"
#include "tests/support/child_process.h"
#include "tests/support/temporary_folder.h"

namespace orthonav {
namespace {

using test::ChildProcess;

// A level turn clockwise through `turns` circles in 4 s, with iron; the compass at heading 0 at the start.
void record_turn(const std::filesystem::path& file, double turns) {
  LogWriter writer(file);
  for (int i = 1; i <= 800; ++i) {
    imu_t imu{};
    imu.utime = 1'000'000 + 5000 * i;
    imu.angular_rate[2] = -2 * M_PI * turns / 4;
    imu.specific_force[2] = 9.81;
    writer.write(imu.utime, channel::kImu, imu);
    if (i % 4 != 0) continue;
    const double heading = 2 * M_PI * turns * i / 800;
    magnetometer_t sample{};
    sample.utime = imu.utime;
    sample.field[0] = 1.1 * 20e-6 * std::cos(heading) + 7e-6;
    sample.field[1] = 20e-6 * std::sin(heading) - 4e-6;
    sample.field[2] = -44e-6;
    writer.write(sample.utime, channel::kMagnetometer, sample);
  }
}

TEST(CompassProcess, ACalibratedMagnetometerGivesTheHeadingOnTheBus) {
  const test::TemporaryFolder folder;
  record_turn(folder / "turn.lcm", 1.0);
  ChildProcess calibrate(
      {test::program("orthonav-calibrate-compass"), folder / "turn.lcm", "--out", folder / "compass.yaml"});
  ASSERT_EQ(calibrate.wait_exit(test::kPatience), 0);

  lcm::LCM bus;
  ASSERT_TRUE(bus.good());
  test::Collector<compass_t> compass(bus, channel::kCompass);
  ChildProcess ingest(
      {test::program("orthonav-ingest"), "--config", folder.path(), "--log", folder / "turn.lcm", "--speed", "4"});
  ASSERT_TRUE(test::handle_until(bus, [&] { return compass.messages.size() == 200; }));
  for (size_t i = 0; i < 200; ++i) {
    const double expected = 2 * M_PI * static_cast<double>(i + 1) / 200;
    EXPECT_LT(std::abs(std::remainder(compass.messages[i].heading - expected, 2 * M_PI)), 1e-3) << i;
    EXPECT_NEAR(compass.messages[i].heading_stddev, 2 * M_PI / 180, 0.01);
  }
}

TEST(CompassProcess, HalfATurnIsRefusedWithTheReasonAndWritesNothing) {
  const test::TemporaryFolder folder;
  record_turn(folder / "half.lcm", 0.5);
  ChildProcess calibrate(
      {test::program("orthonav-calibrate-compass"), folder / "half.lcm", "--out", folder / "compass.yaml"},
      folder / "output.txt");
  EXPECT_EQ(calibrate.wait_exit(test::kPatience), 1);
  std::ifstream stream(folder / "output.txt");
  const std::string output((std::istreambuf_iterator<char>(stream)), std::istreambuf_iterator<char>());
  EXPECT_NE(output.find("whole turn"), std::string::npos) << output;
  EXPECT_FALSE(std::filesystem::exists(folder / "compass.yaml"));
}

}  // namespace
}  // namespace orthonav
