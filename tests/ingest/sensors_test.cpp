// What the devices of a board are read with: IIO's records, lines, a sensor's clock, the watch over it.
#include <cmath>
#include <fstream>
#include <functional>
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

const SensorMessage kAny = compass_t{};

TEST(SensorWatch, SaysWhenASensorIsSilentAndWhenItIsBack) {
  SensorWatch watch("IMU", 0.5);
  EXPECT_EQ(watch.complaint(1'000'000), "");
  EXPECT_THAT(watch.complaint(1'600'000), HasSubstr("IMU: nothing has come"));
  watch.judged(kAny, "", 1'700'000);
  EXPECT_EQ(watch.complaint(2'200'000), "");
  EXPECT_THAT(watch.complaint(2'201'000), HasSubstr("IMU: silent for 0.5 s"));
  watch.judged(kAny, "", 2'300'000);
  EXPECT_EQ(watch.complaint(2'400'000), "");
}

TEST(SensorWatch, SaysWhenMoreThanATenthIsRefused) {
  SensorWatch watch("IMU");
  for (int i = 0; i < 100; ++i) watch.judged(kAny, i % 20 == 0 ? "is not finite" : "", 1'000'000 + 5'000 * i);
  EXPECT_EQ(watch.complaint(1'500'000), "");
  for (int i = 0; i < 100; ++i) watch.judged(kAny, i % 5 == 0 ? "is not finite" : "", 1'500'000 + 5'000 * i);
  EXPECT_THAT(watch.complaint(2'000'000), HasSubstr("is not finite"));
}

TEST(SensorWatch, AFrozenImuMeasuresNothing) {
  SensorWatch watch("IMU");
  for (int i = 0; i < 60; ++i) EXPECT_FALSE(watch.frozen(imu_of(0.1), 1'000'000 + 5'000 * i, 0)) << i;
  EXPECT_TRUE(watch.frozen(imu_of(0.1), 1'300'000, 0));
  EXPECT_FALSE(watch.frozen(imu_of(0.2), 1'305'000, 0));
  EXPECT_FALSE(watch.frozen(imu_of(0.1), 1'310'000, 0));
}

TEST(SensorWatch, ACompassMayStandStillUntilTheBoardTurns) {
  magnetometer_t field{};
  field.field[0] = 20e-6;
  for (const SensorMessage& still : {SensorMessage(compass_t{}), SensorMessage(field)}) {
    SensorWatch watch("COMPASS");
    int64_t now = 1'000'000;
    const auto read = [&](double yaw) { return watch.frozen(still, now += 50'000, yaw); };
    for (int i = 0; i < 1000; ++i) EXPECT_FALSE(read(0.1 * 0.05 * i)) << "a gyroscope's bias of 6 degrees/s is no turn";
    double yaw = 0.1 * 0.05 * 1000;
    for (int i = 0; i < 100; ++i) EXPECT_FALSE(read(yaw));
    for (int i = 0; i < 6; ++i) EXPECT_FALSE(read(yaw += 0.05)) << "0.3 rad";
    EXPECT_TRUE(read(yaw + 0.1));
    for (int i = 0; i < 200; ++i) EXPECT_TRUE(read(yaw)) << "turning back makes no reading of it";
    watch.forget_turn(now, yaw);
    EXPECT_FALSE(read(yaw)) << "if it was one";
    EXPECT_TRUE(read(yaw + 1));
    EXPECT_FALSE(watch.frozen(SensorMessage(magnetometer_t{}), now, yaw)) << "another one is a reading";
    for (int i = 0; i < 20; ++i) EXPECT_FALSE(read(yaw));
    now += 30'000'000;
    EXPECT_FALSE(read(yaw + 3)) << "how the board turned in a long silence is not known";
  }
}

TEST(SensorWatch, ACompassThatIsSentMoreOftenThanItMeasuresIsNotFrozen) {
  SensorWatch watch("COMPASS");
  compass_t compass{};
  for (int i = 0; i < 1000; ++i) {  // five a second, four times each, at 170 degrees/s
    if (i % 4 == 0) compass.heading = -0.15 * i;
    EXPECT_FALSE(watch.frozen(compass, 1'000'000 + 50'000 * i, 0.15 * i));
  }
}

// A sensor that sends every `period` microseconds from `now` on for `duration`, asked ten times a second as the service
// does. The first complaint, and how long after the start it came, microseconds.
std::pair<int64_t, std::string> first_complaint(SensorWatch& watch, int64_t& now, int64_t period, int64_t duration,
                                                const std::function<SensorMessage()>& read) {
  const int64_t start = now;
  int64_t asked = now - now % 100'000;
  std::pair<int64_t, std::string> first{duration, ""};
  while (now < start + duration) {
    now += period;
    while (asked + 100'000 <= now) {
      asked += 100'000;
      const std::string complaint = watch.complaint(asked);
      if (first.second.empty() && !complaint.empty()) first = {asked - start, complaint};
    }
    const SensorMessage message = read();
    watch.judged(message, watch.frozen(message, now, 0) ? "the very same reading" : "", now);
  }
  return first;
}

// A camera over moving ground.
class MovingPicture {
 public:
  SensorMessage operator()() {
    ++number_;
    return last();
  }
  SensorMessage last() const {
    image_t image{};
    image.data.assign(4, number_);
    return image;
  }

 private:
  uint8_t number_ = 0;
};

TEST(SensorWatch, AFrozenCameraIsSeenWithinASecondAtAnyRate) {
  for (const int64_t period : {16'667, 33'333, 40'000, 66'667, 83'333, 100'000, 200'000}) {
    for (int64_t phase = 0; phase < 100'000; phase += 7'000) {
      SensorWatch watch("CAMERA");
      MovingPicture see;
      int64_t now = 1'000'000 + phase;
      ASSERT_EQ(first_complaint(watch, now, period, 10'000'000, std::ref(see)).second, "") << period;
      const auto [after, complaint] = first_complaint(watch, now, period, 3'000'000, [&] { return see.last(); });
      EXPECT_LT(after, 1'000'000) << period << " " << phase;
      EXPECT_GT(after, 700'000) << period;
      EXPECT_THAT(complaint, testing::AllOf(HasSubstr("CAMERA: "), HasSubstr("the very same reading")));
      first_complaint(watch, now, period, 1'000'000, std::ref(see));
      EXPECT_EQ(watch.complaint(now), "");
    }
  }
}

TEST(SensorWatch, ARateThatFallsBelowTwoFifthsOfItsOwnIsSeenWithinASecondUntilItIsBack) {
  MovingPicture see;
  for (const int64_t period : {1'000, 5'000, 33'000, 100'000}) {
    for (const int64_t slower : {3, 10}) {
      SensorWatch watch("CAMERA");
      int64_t now = 1'037'000;
      ASSERT_EQ(first_complaint(watch, now, period, 10'000'000, std::ref(see)).second, "") << period;
      ASSERT_EQ(first_complaint(watch, now, 2 * period, 5'000'000, std::ref(see)).second, "")
          << "half of it is no fault";
      ASSERT_EQ(first_complaint(watch, now, period, 20'000'000, std::ref(see)).second, "") << period;
      const auto [after, complaint] = first_complaint(watch, now, slower * period, 60'000'000, std::ref(see));
      EXPECT_LT(after, 1'000'000) << period << " " << slower;
      EXPECT_THAT(complaint, testing::AnyOf(HasSubstr("messages a second, where there were"), HasSubstr("silent")));
      EXPECT_NE(watch.complaint(now), "") << "it is not the usual rate, however long it lasts";
      first_complaint(watch, now, period, 1'000'000, std::ref(see));
      EXPECT_EQ(watch.complaint(now), "") << period;
    }
  }
}

TEST(SensorWatch, ASensorThatStopsIsSilentAndNotSlow) {
  SensorWatch watch("CAMERA");
  int64_t now = 1'000'000;
  MovingPicture see;
  ASSERT_EQ(first_complaint(watch, now, 5'000, 10'000'000, std::ref(see)).second, "");
  for (const int64_t end = now + 500'000; now < end; now += 10'000) EXPECT_EQ(watch.complaint(now), "");
  EXPECT_THAT(watch.complaint(now + 1'000), HasSubstr("CAMERA: silent"));
}

TEST(SensorWatch, PausesThatAreAllowedAreNoSlowness) {
  SensorWatch watch("CAMERA", 2);
  int64_t now = 1'000'000;
  MovingPicture see;
  ASSERT_EQ(first_complaint(watch, now, 33'000, 30'000'000, std::ref(see)).second, "");
  ASSERT_EQ(first_complaint(watch, now, 1'900'000, 1'900'000, std::ref(see)).second, "");
  ASSERT_EQ(first_complaint(watch, now, 33'000, 30'000'000, std::ref(see)).second, "");
}

TEST(SensorWatch, ABacklogThatComesAtOnceIsNotTheUsualRate) {
  SensorWatch watch("CAMERA");
  MovingPicture see;
  int64_t now = 1'000'000;
  first_complaint(watch, now, 1'000, 800'000, std::ref(see));
  EXPECT_EQ(first_complaint(watch, now, 33'000, 30'000'000, std::ref(see)).second, "");
}

// An IMU: noise of `vibration` on all axes, gravity, and what `bad` does to a reading.
class FlyingImu {
 public:
  SensorMessage operator()() {
    imu_t imu{};
    for (int i = 0; i < 3; ++i) {
      imu.angular_rate[i] = 0.025 * vibration * noise();
      imu.specific_force[i] = (i == 2 ? 9.8 : 0.0) + vibration * noise();
    }
    if (bad) bad(imu);
    return imu;
  }
  double noise() { return noise_(random_); }

  double vibration = 2;  // m/s^2
  std::function<void(imu_t&)> bad;

 private:
  std::mt19937 random_{1};
  std::normal_distribution<double> noise_;
};

TEST(SensorWatch, AnImuThatMeasuresWhatNoAircraftDoesIsSeenWithinASecond) {
  FlyingImu imu;
  const std::vector<std::pair<std::function<void(imu_t&)>, std::string>> cases{
      {[](imu_t& m) { m.angular_rate[1] = 0.125; }, "IMU: angular_rate[1] has read 0.125"},
      {[](imu_t& m) { m.specific_force[2] = 16; }, "IMU: specific_force[2] has read 16"},
      {[&](imu_t& m) { m.angular_rate[0] = 3 * imu.noise(); }, "IMU: angular_rate leaps"},
      {[&](imu_t& m) { m.specific_force[0] = 150 * imu.noise(); }, "IMU: specific_force leaps"},
      {[](imu_t& m) {
         for (double& f : m.specific_force) f /= 9.8;
       },
       "is it in g?"},
      {[n = 0](imu_t& m) mutable { m.angular_rate[1] += ++n % 8 == 0 ? 5 : 0; }, "IMU: angular_rate leaps"},
      {[](imu_t& m) { m.specific_force[1] += 150; }, "IMU: specific_force is"},
      {[](imu_t& m) { m.angular_rate[2] += 30; }, "is it in degrees?"}};
  for (const auto& [bad, what] : cases) {
    for (const int64_t period : {1'000, 5'000, 20'000}) {
      SensorWatch watch("IMU");
      int64_t now = 1'037'000;
      imu.bad = nullptr;
      ASSERT_EQ(first_complaint(watch, now, period, 10'000'000, std::ref(imu)).second, "");
      imu.bad = bad;
      const auto [after, complaint] = first_complaint(watch, now, period, 5'000'000, std::ref(imu));
      EXPECT_LT(after, 1'000'000) << what << " at " << period;
      EXPECT_THAT(complaint, HasSubstr(what));
      imu.bad = nullptr;
      first_complaint(watch, now, period, 700'000, std::ref(imu));
      EXPECT_EQ(watch.complaint(now), "") << what;
    }
  }
}

TEST(SensorWatch, WhatIsWrongWithAnImuIsAllSaid) {
  FlyingImu imu;
  imu.bad = [n = 0](imu_t& m) mutable {
    m.angular_rate[1] = 0.125;
    m.specific_force[0] = 1;
    if (++n % 5 == 0) m.angular_rate[0] = 1e9;
  };
  SensorWatch watch("IMU");
  for (int64_t now = 1'000'000; now < 3'000'000; now += 5'000) {
    const SensorMessage message = imu();
    watch.judged(message, std::get<imu_t>(message).angular_rate[0] > 1e6 ? "out of range" : "", now);
  }
  EXPECT_THAT(watch.complaint(3'000'000),
              testing::AllOf(HasSubstr("refused: out of range"), HasSubstr("angular_rate[1] has read 0.125"),
                             HasSubstr("specific_force[0] has read 1")));
}

TEST(SensorWatch, AnImuAtRestMayRepeatItselfForAWhileAndMeasuresItsWeight) {
  FlyingImu imu;
  imu.vibration = 0.01;
  for (const int64_t period : {1'000, 5'000, 20'000}) {
    SensorWatch watch("IMU");
    int64_t now = 1'000'000, coarse_until = 0;
    imu.bad = [&](imu_t& m) {
      if (now < coarse_until) m.angular_rate[0] = 0.001;
    };
    for (int i = 0; i < 10; ++i) {
      coarse_until = now + 5'000'000;
      EXPECT_EQ(first_complaint(watch, now, period, 6'000'000, std::ref(imu)).second, "") << period;
    }
    for (int i = 0; i < 20; ++i) {  // a knock on the landing gear, now and then
      coarse_until = now + 1'500'000;
      EXPECT_EQ(first_complaint(watch, now, period, 1'400'000, std::ref(imu)).second, "") << period;
      const auto flying = imu.bad;
      imu.bad = [&](imu_t& m) {
        flying(m);
        m.specific_force[2] += 3;
      };
      EXPECT_EQ(first_complaint(watch, now, period, period, std::ref(imu)).second, "") << period;
      imu.bad = flying;
      EXPECT_EQ(first_complaint(watch, now, period, 300'000, std::ref(imu)).second, "") << period;
    }
    coarse_until = now + 100'000'000;
    const auto [after, complaint] = first_complaint(watch, now, period, 20'000'000, std::ref(imu));
    EXPECT_THAT(complaint, HasSubstr("angular_rate[0] has read 0.001"));
    EXPECT_GT(after, 9'000'000) << "a dead axis, after all";
    imu.bad = [](imu_t& m) {
      for (double& f : m.specific_force) f *= 2;
    };
    first_complaint(watch, now, period, 1'000'000, std::ref(imu));
    EXPECT_THAT(watch.complaint(now), HasSubstr("is its scale right?"));
  }
}

TEST(SensorWatch, MotorsThatStartVibrationsAndATurnAreNoMadness) {
  FlyingImu imu;
  for (const int64_t period : {1'000, 5'000, 20'000}) {
    SensorWatch watch("IMU");
    int64_t now = 1'037'000;
    imu.bad = nullptr;
    imu.vibration = 0.02;
    EXPECT_EQ(first_complaint(watch, now, period, 20'000'000, std::ref(imu)).second, "") << "motors off";
    imu.bad = [](imu_t& m) {  // in a turn of 3 g
      for (double& w : m.angular_rate) w = 1 + 0.3 * w;
      m.specific_force[2] += 19.6;
    };
    imu.vibration = 30;
    EXPECT_EQ(first_complaint(watch, now, period, 100'000'000, std::ref(imu)).second, "") << period;
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
