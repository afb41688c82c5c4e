#include "tools/simulate/flight_recorder.h"

#include <fstream>
#include <iterator>
#include <set>

#include <gtest/gtest.h>

#include "common/bus/channels.h"
#include "common/camera/image_decode.h"
#include "common/flightlog/flightlog.h"
#include "orthonav/compass_t.hpp"
#include "orthonav/gnss_reference_t.hpp"
#include "orthonav/image_t.hpp"
#include "orthonav/imu_t.hpp"
#include "orthonav/truth_t.hpp"
#include "tests/simulate/flight_fixtures.h"
#include "tests/support/temporary_folder.h"
#include "tools/simulate/ordered_parallel.h"

namespace orthonav::simulate {
namespace {

class Recording : public testing::Test {
 protected:
  RecordingSummary record(const std::string& name, uint64_t seed, int threads, const std::string& asl = "") {
    RecordingOptions options{
        .log = folder_ / name, .asl_folder = {}, .seconds = 1.5, .threads = threads, .progress = {}};
    if (!asl.empty()) options.asl_folder = folder_ / asl;
    return record_flight(scenario_, world_, seed, options);
  }
  std::string bytes(const std::string& name) const {
    std::ifstream in(folder_ / name, std::ios::binary);
    return {std::istreambuf_iterator<char>(in), {}};
  }

  test::TemporaryFolder folder_;
  World world_ = rolling_world(510, 400);
  Scenario scenario_ = Scenario::load(config_folder("rural"));
};

TEST_F(Recording, IsTheSameForAnyNumberOfThreads) {
  record("one.lcm", 1, 1);
  record("three.lcm", 1, 3);
  record("other.lcm", 2, 3);
  EXPECT_GT(bytes("one.lcm").size(), 100000U);
  EXPECT_TRUE(bytes("one.lcm") == bytes("three.lcm"));
  EXPECT_FALSE(bytes("one.lcm") == bytes("other.lcm"));
}

TEST_F(Recording, IsALogOfAllSensorsInTimeOrder) {
  const RecordingSummary summary = record("flight.lcm", 1, 2);
  EXPECT_EQ(summary.outside, 0);
  EXPECT_EQ(summary.seconds, 1.5);
  LogReader reader(folder_ / "flight.lcm");
  std::map<std::string, int> count;
  int64_t last = 0;
  while (const auto event = reader.next()) {
    EXPECT_GE(event->utime, last);
    last = event->utime;
    ++count[event->channel];
    if (event->channel == channel::kCamera) {
      const auto image = event->decode<image_t>();
      ASSERT_TRUE(image);
      EXPECT_EQ(image->utime, event->utime);
      EXPECT_TRUE(decode_image(*image, 640, 480).ok());
      ASSERT_EQ(image->nmetadata, 1);
      EXPECT_EQ(image->metadata[0].key, "exposure_us");
      EXPECT_EQ(std::string(image->metadata[0].value.begin(), image->metadata[0].value.end()), "4000");
    }
    if (event->channel == channel::kImu) {
      EXPECT_EQ(event->decode<imu_t>()->utime, event->utime);
    }
    if (event->channel == channel::kTruth) {
      EXPECT_EQ(event->decode<truth_t>()->utime, event->utime);
    }
  }
  EXPECT_EQ(reader.skipped_bytes(), 0);
  EXPECT_EQ(count[channel::kImu], 301);
  EXPECT_EQ(count[channel::kCamera], 15);
  EXPECT_EQ(count[channel::kCompass], 15);
  EXPECT_EQ(count[channel::kGnssReference], 16);
  EXPECT_GE(count[channel::kTruth], 31 + 14);
  EXPECT_EQ(count[channel::kAltitude], 0);
}

TEST_F(Recording, LosesImagesAndLeavesTheOthersAsTheyWere) {
  const auto images = [&](const std::string& name) {
    record(name, 1, 2);
    std::map<int64_t, std::vector<uint8_t>> all;
    LogReader reader(folder_ / name);
    while (const auto event = reader.next()) {
      if (event->channel == channel::kCamera) all[event->utime] = event->decode<image_t>()->data;
    }
    return all;
  };
  const auto whole = images("whole.lcm");
  scenario_.sensors.camera.dropped = 0.4;
  const auto some = images("some.lcm");
  EXPECT_LT(some.size(), whole.size());
  EXPECT_FALSE(some.empty());
  for (const auto& [utime, data] : some) {
    ASSERT_EQ(whole.count(utime), 1U);
    EXPECT_TRUE(whole.at(utime) == data);
  }
}

TEST_F(Recording, ReadsARollingShutterRowByRow) {
  record("global.lcm", 1, 2);
  scenario_.camera_effects.readout_ms = 30;
  record("rolling.lcm", 1, 2);
  const auto first_image = [&](const std::string& name) {
    LogReader reader(folder_ / name);
    while (auto event = reader.next()) {
      if (event->channel == channel::kCamera) return decode_image(*event->decode<image_t>(), 640, 480).grey;
    }
    return cv::Mat();
  };
  cv::Mat difference;
  cv::absdiff(first_image("global.lcm"), first_image("rolling.lcm"), difference);
  EXPECT_LT(cv::mean(difference.rowRange(236, 244))[0], 0.5) << "the middle row is of the image's time";
  EXPECT_GT(cv::mean(difference.rowRange(0, 8))[0], 2 * cv::mean(difference.rowRange(236, 244))[0]);
  EXPECT_GT(cv::mean(difference.rowRange(472, 480))[0], 2 * cv::mean(difference.rowRange(236, 244))[0]);
}

TEST_F(Recording, WritesTheSameFlightAsAnAslFolder) {
  record("flight.lcm", 1, 2, "asl");
  const auto root = folder_ / "asl" / "mav0";
  for (const char* file : {"body.yaml", "cam0/sensor.yaml", "cam0/data.csv", "imu0/sensor.yaml", "imu0/data.csv",
                           "state_groundtruth_estimate0/sensor.yaml", "state_groundtruth_estimate0/data.csv"}) {
    EXPECT_TRUE(std::filesystem::is_regular_file(root / file)) << file;
  }
  const auto lines = [&](const std::string& file) {
    std::ifstream in(root / file);
    std::vector<std::string> all;
    for (std::string line; std::getline(in, line);) all.push_back(line);
    return all;
  };
  EXPECT_EQ(lines("imu0/data.csv").size(), 1U + 301U);
  EXPECT_EQ(lines("imu0/data.csv")[0].substr(0, 40), "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS");
  const auto images = lines("cam0/data.csv");
  ASSERT_EQ(images.size(), 1U + 15U);
  EXPECT_EQ(images[0], "#timestamp [ns],filename");
  for (size_t i = 1; i < images.size(); ++i) {
    const std::string stamp = images[i].substr(0, 19), name = images[i].substr(20);
    EXPECT_EQ(name, stamp + ".jpg");
    EXPECT_TRUE(std::filesystem::is_regular_file(root / "cam0" / "data" / name)) << name;
  }
  // The first image of the log, byte for byte.
  LogReader reader(folder_ / "flight.lcm");
  std::optional<LogEvent> event = reader.next();
  while (event && event->channel != channel::kCamera) event = reader.next();
  ASSERT_TRUE(event);
  const auto image = event->decode<image_t>();
  EXPECT_EQ(std::to_string(image->utime) + "000", images[1].substr(0, 19));
  EXPECT_EQ(bytes("asl/mav0/cam0/data/" + images[1].substr(20)), std::string(image->data.begin(), image->data.end()));
  EXPECT_EQ(lines("state_groundtruth_estimate0/data.csv")[1].substr(0, 20),
            std::to_string(scenario_.start_unix_s) + "000000000,");
}

TEST_F(Recording, BeginsOnTheGroundWhereItTakesOff) {
  scenario_.flight.take_off = true;
  const RecordingSummary summary = record("flight.lcm", 1, 2);
  EXPECT_GT(summary.flight_seconds, scenario_.flight.duration_s + scenario_.flight.standstill_s);
  LogReader reader(folder_ / "flight.lcm");
  int images = 0;
  while (const auto event = reader.next()) {
    if (event->channel == channel::kTruth) {
      EXPECT_LT(event->decode<truth_t>()->height_above_ground, 0.3);
    }
    if (event->channel == channel::kCamera) {
      EXPECT_TRUE(decode_image(*event->decode<image_t>(), 640, 480).ok());
      ++images;
    }
  }
  EXPECT_EQ(images, 15);
}

TEST_F(Recording, SaysWhichFileCannotBeWritten) {
  RecordingOptions options{
      .log = folder_ / "no" / "such" / "folder.lcm", .asl_folder = {}, .seconds = 1, .threads = 1, .progress = {}};
  try {
    record_flight(scenario_, world_, 1, options);
    FAIL();
  } catch (const std::runtime_error& error) {
    EXPECT_NE(std::string(error.what()).find("folder.lcm"), std::string::npos);
  }
}

TEST(Scenario, EveryFolderOfConfigLoads) {
  for (const char* name : {"default", "rural", "testing_zone", "quick", "port_kalimantan", "portugal_village"}) {
    EXPECT_NO_THROW(Scenario::load(config_folder(name))) << name;
  }
  EXPECT_EQ(Scenario::load(config_folder("quick")).record_s, 100);
}

TEST(Scenario, FieldsOfViewAreThoseOfThePaper) {
  const auto degrees = [](double size, double focal) { return 2 * std::atan(0.5 * size / focal) * 57.29577951; };
  const CameraParameters rural = Scenario::load(config_folder("rural")).camera.parameters();
  EXPECT_NEAR(degrees(rural.width, rural.fx), 41, 0.5);
  EXPECT_NEAR(degrees(rural.height, rural.fy), 32, 0.5);
  const CameraParameters zone = Scenario::load(config_folder("testing_zone")).camera.parameters();
  EXPECT_EQ(zone.height, 512);
  EXPECT_NEAR(degrees(zone.width, zone.fx), 67, 0.5);
  EXPECT_NEAR(degrees(zone.height, zone.fy), 56, 0.5);
}

TEST(Scenario, AMisspeltKeyIsAnErrorWithItsLine) {
  const test::TemporaryFolder folder;
  std::filesystem::copy_file(config_folder("default") / "aircraft.yaml", folder / "aircraft.yaml");
  folder.write("simulate.yaml", "start_unix_s: 1\nflight:\n  hieght_m: 3\n");
  try {
    Scenario::load(folder.path());
    ADD_FAILURE() << "accepted";
  } catch (const ConfigError& error) {
    EXPECT_NE(std::string(error.what()).find("simulate.yaml:3"), std::string::npos) << error.what();
    EXPECT_NE(std::string(error.what()).find("hieght_m"), std::string::npos) << error.what();
  }
}

TEST(Scenario, AShutterThatRollsBackwardsIsRefused) {
  ConfigNode node = ConfigNode::parse("readout_ms: -5", "test");
  EXPECT_THROW(CameraEffectOptions::from_config(node), ConfigError);
}

TEST(OrderedParallel, ConsumesInOrderAndPassesErrorsOn) {
  std::vector<size_t> order;
  ordered_parallel(
      200, 4, [](size_t i) { return i * i; },
      [&](size_t i, size_t square) {
        EXPECT_EQ(square, i * i);
        order.push_back(i);
      });
  EXPECT_TRUE(std::is_sorted(order.begin(), order.end()));
  EXPECT_EQ(order.size(), 200U);
  const auto fail_at = [](size_t bad) {
    return [bad](size_t i) {
      if (i == bad) throw std::runtime_error("made badly");
      return i;
    };
  };
  EXPECT_THROW(ordered_parallel(200, 3, fail_at(100), [](size_t, size_t) {}), std::runtime_error);
  EXPECT_THROW(ordered_parallel(
                   200, 3, [](size_t i) { return i; },
                   [](size_t i, size_t) {
                     if (i == 50) throw std::invalid_argument("not wanted");
                   }),
               std::invalid_argument);
}

}  // namespace
}  // namespace orthonav::simulate
