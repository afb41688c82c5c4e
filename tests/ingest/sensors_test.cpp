// What the devices of a board are read with: IIO's records, lines, a sensor's clock, the watch over it.
#include <cmath>
#include <fstream>
#include <random>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "common/config/config.h"
#include "services/ingest/iio_scan.h"
#include "services/ingest/sensor_clock.h"
#include "services/ingest/sensor_lines.h"
#include "services/ingest/sensor_options.h"
#include "services/ingest/sensor_watch.h"
#include "tests/support/temporary_folder.h"

namespace orthonav::ingest {
namespace {

using testing::HasSubstr;

TEST(IioType, DecodesEitherEndSignAndShift) {
  const uint8_t bytes[] = {0xFF, 0xF0, 0, 0, 0, 0, 0, 0x80};
  EXPECT_EQ(IioType::parse("be:s16/16>>0").decode(bytes), -16);
  EXPECT_EQ(IioType::parse("le:u16/16>>0").decode(bytes), 0xF0FF);
  EXPECT_EQ(IioType::parse("be:s12/16>>4").decode(bytes), -1);
  EXPECT_EQ(IioType::parse("be:u12/16>>4").decode(bytes), 0xFFF);
  EXPECT_EQ(IioType::parse("le:s64/64>>0").decode(bytes), static_cast<int64_t>(0x800000000000F0FFU));
}

TEST(IioType, RefusesWhatIsNoType) {
  for (const char* text : {"", "s16/16>>0", "xx:s16/16>>0", "le:s16/17>>0", "le:s20/16>>0", "le:s16/16>>4",
                           "le:s0/8>>0", "le:s16/16>>0 and more", "le:s16/16X2>>0", "le:f32/32>>0", "le:s-1/16>>0"}) {
    EXPECT_THROW(IioType::parse(text), std::runtime_error) << text;
  }
}

TEST(IioRecord, AlignsEachChannelToItsSizeAndTheWholeToTheLargest) {
  std::vector<IioChannel> channels(4);
  channels[0].index = 9;  // the time stamp, which the kernel puts last
  channels[0].type = IioType::parse("le:s64/64>>0");
  for (int i = 0; i < 3; ++i) {
    channels[static_cast<size_t>(i) + 1].index = i;
    channels[static_cast<size_t>(i) + 1].type = IioType::parse(i == 2 ? "le:s32/32>>0" : "le:s16/16>>0");
  }
  EXPECT_EQ(lay_out(channels), 16u);
  EXPECT_EQ(channels[1].position, 2u);
  EXPECT_EQ(channels[2].position, 4u);
  EXPECT_EQ(channels[3].index, 9);
  EXPECT_EQ(channels[3].position, 8u);
}

std::string line(const std::string& text) {
  return fmt::format("${}*{:02X}\r\n", text, line_checksum(text));
}

TEST(SensorLines, MakeMessagesInSiUnits) {
  SensorLines lines("port", true);
  std::vector<SensorEvent> events;
  lines.feed(line("IMU,1000,0.1,-0.2,0.3,1,2,9.8,40.5") + line("MAG,2000,20,0,-44") + line("HDG,3000,90,2") +
                 line("ALT,4000,110.5,1.5"),
             0, events);
  ASSERT_EQ(events.size(), 4u);
  for (const auto& event : events) ASSERT_TRUE(event.message) << event.error;
  const auto& imu = std::get<imu_t>(*events[0].message);
  EXPECT_EQ(imu.utime, 1000);
  EXPECT_EQ(imu.angular_rate[1], -0.2);
  EXPECT_EQ(imu.specific_force[2], 9.8);
  EXPECT_EQ(imu.temperature_deg_c, 40.5F);
  EXPECT_DOUBLE_EQ(std::get<magnetometer_t>(*events[1].message).field[2], -44e-6);
  EXPECT_DOUBLE_EQ(std::get<compass_t>(*events[2].message).heading, M_PI / 2);
  EXPECT_EQ(std::get<altitude_t>(*events[3].message).height_above_ground, 110.5);
}

TEST(SensorLines, ComeInPiecesOfAnySize) {
  const std::string text = line("MAG,1,1,2,3") + line("MAG,2,1,2,3");
  for (size_t piece = 1; piece < text.size(); ++piece) {
    SensorLines lines("port", true);
    std::vector<SensorEvent> events;
    for (size_t at = 0; at < text.size(); at += piece) lines.feed(text.substr(at, piece), 0, events);
    ASSERT_EQ(events.size(), 2u) << "in pieces of " << piece;
    EXPECT_TRUE(events[0].message && events[1].message);
  }
}

TEST(SensorLines, WhatIsDamagedIsSaidAndTheNextLineIsRead) {
  const std::string good = line("MAG,7,1,2,3");
  std::string flipped = line("MAG,6,1,2,3");
  flipped[5] = '5';
  const std::vector<std::pair<std::string, std::string>> cases{{flipped, "checksum is wrong"},
                                                               {"$MAG,1,1,2,3\n", "without checksum"},
                                                               {"$MAG,1,1,2,3*\n", "without checksum"},
                                                               {line("MAG,1,1,2"), "wrong number of fields"},
                                                               {line("MAG,1,1,2,3,4"), "wrong number of fields"},
                                                               {line("XYZ,1,1,2,3"), "unknown line"},
                                                               {line("MAG,1.5,1,2,3"), "no number"},
                                                               {line("MAG,1,1,,3"), "no number"},
                                                               {line("MAG"), "no number"},
                                                               {"$" + std::string(5000, 'x') + "\n", "no line"},
                                                               {std::string(5000, '\xFF'), "no line"},
                                                               {"$MAG,1,1,2", "no line"}};
  for (const auto& [bad, why] : cases) {
    SensorLines lines("/dev/ttyX", true);
    std::vector<SensorEvent> events;
    lines.feed(bad + good, 0, events);
    ASSERT_GE(events.size(), 2u) << bad;
    EXPECT_THAT(events[0].error, HasSubstr("/dev/ttyX: "));
    EXPECT_THAT(events[0].error, HasSubstr(why));
    ASSERT_TRUE(events.back().message) << bad;
    EXPECT_EQ(utime_of(*events.back().message), 7);
  }
}

TEST(SensorClock, KeepsTheSensorsSpacingWhenMessagesAreLate) {
  std::mt19937 random(1);
  std::exponential_distribution<double> late(1 / 2000.0);  // 2 ms in the mean
  SensorClock clock;
  const double drift = 50e-6;
  int64_t last = 0;
  for (int i = 0; i < 20000; ++i) {
    const int64_t sensor = 5000 * i;
    const double truth = 1e15 + 5000.0 * i * (1 + drift);
    const int64_t host = clock.to_host(sensor, std::llround(truth + 500 + late(random)));
    if (i > 1000) {
      EXPECT_NEAR(static_cast<double>(host) - truth, 500, 500) << "sample " << i;
      EXPECT_NEAR(static_cast<double>(host - last), 5000, 500) << "sample " << i;
    }
    last = host;
  }
}

TEST(SensorClock, IsSetAnewWhenTheSensorStartsAgain) {
  SensorClock clock;
  EXPECT_EQ(clock.to_host(900'000'000, 5'000'000'000), 5'000'000'000);
  EXPECT_NEAR(static_cast<double>(clock.to_host(900'005'000, 5'000'006'000)), 5'000'005'000, 1);
  EXPECT_EQ(clock.to_host(899'500'000, 5'000'010'000), 5'000'010'000);
  EXPECT_EQ(clock.to_host(1'000, 5'002'000'000), 5'002'000'000);
  EXPECT_NEAR(static_cast<double>(clock.to_host(6'000, 5'002'009'000)), 5'002'005'000, 1);
}

imu_t imu_of(double rate) {
  imu_t imu{};
  imu.angular_rate[0] = rate;
  return imu;
}

TEST(SensorWatch, SaysWhenASensorIsSilentAndWhenItIsBack) {
  SensorWatch watch("IMU", 0.5);
  EXPECT_EQ(watch.complaint(1'000'000), "");
  EXPECT_THAT(watch.complaint(1'600'000), HasSubstr("IMU: nothing has come"));
  watch.judged("", 1'700'000);
  EXPECT_EQ(watch.complaint(2'200'000), "");
  EXPECT_THAT(watch.complaint(2'201'000), HasSubstr("IMU: silent for 0.5 s"));
  watch.judged("", 2'300'000);
  EXPECT_EQ(watch.complaint(2'400'000), "");
}

TEST(SensorWatch, SaysWhenMoreThanATenthIsRefused) {
  SensorWatch watch("IMU");
  for (int i = 0; i < 100; ++i) watch.judged(i % 20 == 0 ? "is not finite" : "", 1'000'000 + 5'000 * i);
  EXPECT_EQ(watch.complaint(1'500'000), "");
  for (int i = 0; i < 100; ++i) watch.judged(i % 5 == 0 ? "is not finite" : "", 1'500'000 + 5'000 * i);
  EXPECT_THAT(watch.complaint(2'000'000), HasSubstr("is not finite"));
}

TEST(SensorWatch, AFrozenImuMeasuresNothing) {
  SensorWatch watch("IMU");
  for (int i = 0; i < 60; ++i) EXPECT_FALSE(watch.frozen(imu_of(0.1), 1'000'000 + 5'000 * i)) << i;
  EXPECT_TRUE(watch.frozen(imu_of(0.1), 1'300'000));
  EXPECT_FALSE(watch.frozen(imu_of(0.2), 1'305'000));
  EXPECT_FALSE(watch.frozen(imu_of(0.1), 1'310'000));
  compass_t still{};
  for (int i = 0; i < 1000; ++i)
    EXPECT_FALSE(watch.frozen(still, 1'000'000 + 5'000 * i)) << "a compass may stand still";
}

TEST(SensorWatch, AFrozenCameraIsSeenWithinASecondAtAnyRate) {
  for (const int64_t period : {33'000, 100'000, 200'000}) {
    SensorWatch watch("CAMERA");
    image_t image{};
    image.data.assign(100, 1);
    int64_t now = 1'000'000;
    for (int i = 0; i < 50; ++i) {
      image.data[0] = static_cast<uint8_t>(i);
      EXPECT_FALSE(watch.frozen(image, now += period)) << i;
    }
    const int64_t freeze = now;
    while (now < freeze + 1'000'000 && !watch.frozen(image, now += period)) {
    }
    EXPECT_LT(now, freeze + 1'000'000) << period;
    EXPECT_GT(now, freeze + 700'000) << period;
  }
}

class SensorOptionsFile : public testing::Test {
 protected:
  std::string error_of(const std::string& yaml) const {
    std::ofstream(folder_ / "ingest.yaml") << yaml;
    try {
      SensorOptions::load(folder_.path());
    } catch (const ConfigError& error) {
      return error.what();
    }
    return "";
  }
  test::TemporaryFolder folder_;
};

TEST_F(SensorOptionsFile, ErrorsNameFileLineAndKey) {
  EXPECT_THAT(error_of("silence_s: 1\n"), HasSubstr("names no sensor"));
  EXPECT_THAT(error_of("camera:\n  source: a\n  stamps: maybe\n"), HasSubstr("ingest.yaml:3"));
  EXPECT_THAT(error_of("lines:\n  port: a\n  channels: [IMU, NAV_STATE]\n"), HasSubstr("NAV_STATE"));
  EXPECT_THAT(error_of("iio_imu:\n  device: a\n  R_B_S: [1, 0, 0, 0, 1, 0, 0, 0, -1]\n"), HasSubstr("rotation"));
  EXPECT_THAT(error_of("iio_imu:\n  device: a\n  ratehz: 3\n"), HasSubstr("ratehz"));
  EXPECT_EQ(error_of("camera:\n  source: a\n"), "");
}

}  // namespace
}  // namespace orthonav::ingest
