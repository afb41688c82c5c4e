#include "common/flightlog/flightlog.h"

#include <filesystem>
#include <fstream>

#include <gtest/gtest.h>

#include "orthonav/compass_t.hpp"
#include "orthonav/imu_t.hpp"

namespace orthonav {
namespace {

std::filesystem::path write_log(const std::string& name, int events) {
  const auto file = std::filesystem::path(testing::TempDir()) / name;
  LogWriter writer(file);
  for (int i = 0; i < events; ++i) {
    imu_t imu{};
    imu.utime = 1000 + i;
    imu.angular_rate[1] = i;
    writer.write(imu.utime, "IMU", imu);
  }
  return file;
}

TEST(FlightLog, WhatIsWrittenIsReadBack) {
  LogReader reader(write_log("roundtrip.lcm", 5));
  for (int i = 0; i < 5; ++i) {
    const auto event = reader.next();
    ASSERT_TRUE(event.has_value());
    EXPECT_EQ(event->utime, 1000 + i);
    EXPECT_EQ(event->channel, "IMU");
    const auto imu = event->decode<imu_t>();
    ASSERT_TRUE(imu.has_value());
    EXPECT_EQ(imu->angular_rate[1], i);
    EXPECT_FALSE(event->decode<compass_t>().has_value());
  }
  EXPECT_FALSE(reader.next().has_value());
  EXPECT_EQ(reader.skipped_bytes(), 0);
}

TEST(FlightLog, ADamagedStretchIsPassedOverAndCounted) {
  const auto file = write_log("damaged.lcm", 10);
  const auto event_size = std::filesystem::file_size(file) / 10;
  {
    std::fstream stream(file, std::ios::in | std::ios::out | std::ios::binary);
    stream.seekp(static_cast<std::streamoff>(3 * event_size));
    stream.write("################", 16);  // the header of the fourth event
  }
  LogReader reader(file);
  int count = 0;
  while (reader.next()) ++count;
  // LCM's reader gives up the event before a damaged header as well.
  EXPECT_EQ(count, 8);
  EXPECT_EQ(reader.skipped_bytes(), static_cast<int64_t>(2 * event_size));
}

TEST(FlightLog, ATruncatedLogEndsAtItsLastWholeEvent) {
  const auto file = write_log("truncated.lcm", 10);
  std::filesystem::resize_file(file, std::filesystem::file_size(file) - 20);
  LogReader reader(file);
  int count = 0;
  while (reader.next()) ++count;
  EXPECT_EQ(count, 9);
  EXPECT_GT(reader.skipped_bytes(), 0);
}

TEST(FlightLog, AMissingFileIsAnErrorWithItsName) {
  try {
    const LogReader reader("/nonexistent/flight.lcm");
    FAIL();
  } catch (const std::runtime_error& error) {
    EXPECT_NE(std::string(error.what()).find("/nonexistent/flight.lcm"), std::string::npos);
  }
}

}  // namespace
}  // namespace orthonav
