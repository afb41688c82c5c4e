#include <filesystem>
#include <fstream>

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <opencv2/imgcodecs.hpp>

#include "common/flightlog/flightlog.h"
#include "services/ingest/asl_source.h"
#include "services/ingest/log_source.h"

namespace orthonav::ingest {
namespace {

using testing::HasSubstr;
namespace fs = std::filesystem;

class AslFolder : public testing::Test {
 protected:
  void SetUp() override {
    root_ = fs::path(testing::TempDir()) / testing::UnitTest::GetInstance()->current_test_info()->name();
    fs::remove_all(root_);
    for (const char* folder : {"cam0/data", "imu0", "state_groundtruth_estimate0"}) {
      fs::create_directories(root_ / "mav0" / folder);
    }
    write("imu0/data.csv",
          "#timestamp [ns],wx,wy,wz,ax,ay,az\n1000000,0.1,0.2,0.3,1,2,9.8\n6000000,-0.1,0,0,1,2,9.8\n");
    write("cam0/data.csv", "#timestamp [ns],filename\n1000000,a.png\r\n6000000, b.jpg\n");
    write("state_groundtruth_estimate0/data.csv",
          "#t\n3000000, 10, 20, 30, 1, 0, 0, 0, 4, 5, 6, 7, 8, 9, 10, 11, 12\n");
    const cv::Mat picture(12, 16, CV_8U, cv::Scalar(77));
    cv::imwrite(root_ / "mav0/cam0/data/a.png", picture);
    cv::imwrite(root_ / "mav0/cam0/data/b.jpg", picture);
  }
  void write(const std::string& name, const std::string& text) const { std::ofstream(root_ / "mav0" / name) << text; }
  static std::vector<SensorEvent> all(SensorSource& source) {
    std::vector<SensorEvent> events;
    while (auto event = source.next()) events.push_back(std::move(*event));
    return events;
  }
  fs::path root_;
};

TEST_F(AslFolder, IsReadInTimeOrderWithTheImuFirst) {
  AslSource source(root_);
  const auto events = all(source);
  ASSERT_EQ(events.size(), 5u);
  for (const auto& event : events) ASSERT_TRUE(event.message.has_value()) << event.error;
  const auto& imu = std::get<imu_t>(*events[0].message);
  EXPECT_EQ(imu.utime, 1000);
  EXPECT_EQ(imu.angular_rate[2], 0.3);
  EXPECT_EQ(imu.specific_force[1], 2);
  const auto& png = std::get<image_t>(*events[1].message);
  EXPECT_EQ(png.pixelformat, image_t::PIXEL_FORMAT_GRAY);
  EXPECT_EQ(png.size, 16 * 12);
  EXPECT_EQ(png.data[5], 77);
  const auto& truth = std::get<truth_t>(*events[2].message);
  EXPECT_NEAR(EnuFrame(Geodetic{}).to_enu({truth.latitude_deg, truth.longitude_deg, truth.ellipsoidal_height}).y(), 20,
              1e-6);
  EXPECT_EQ(truth.velocity_enu[2], 6);
  EXPECT_EQ(truth.accel_bias[0], 10);
  EXPECT_TRUE(std::holds_alternative<imu_t>(*events[3].message));
  const auto& jpeg = std::get<image_t>(*events[4].message);
  EXPECT_EQ(jpeg.pixelformat, image_t::PIXEL_FORMAT_MJPEG);
  EXPECT_EQ(jpeg.width, 16);
}

TEST_F(AslFolder, BadRowsAndMissingImagesAreNamedWithFileAndLine) {
  write("imu0/data.csv", "#h\n1000000,0.1,0.2\n6000000,a,b,c,d,e,f\nrubbish\n");
  write("cam0/data.csv", "#h\n2000000,gone.png\n");
  AslSource source(root_);
  std::string errors;
  for (const auto& event : all(source)) errors += event.error + "\n";
  EXPECT_THAT(errors, HasSubstr("imu0/data.csv:2"));
  EXPECT_THAT(errors, HasSubstr("imu0/data.csv:3"));
  EXPECT_THAT(errors, HasSubstr("imu0/data.csv:4"));
  EXPECT_THAT(errors, HasSubstr("gone.png"));
}

TEST_F(AslFolder, ImagesWithoutANameOrThatAreNoFilesAreNamedAndTheRestIsRead) {
  fs::create_directory(root_ / "mav0/cam0/data/folder.png");
  write("cam0/data.csv", "#h\n1000000,\n2000000,   \n3000000,folder.png\n4000000,.\n-5,a.png\n6000000,a.png\n");
  AslSource source(root_);
  std::string errors;
  int images = 0;
  for (const auto& event : all(source)) {
    errors += event.error + "\n";
    if (event.message) images += std::holds_alternative<image_t>(*event.message) ? 1 : 0;
  }
  for (const char* line : {":2:", ":3:", ":4:", ":5:"}) {
    EXPECT_THAT(errors, HasSubstr(std::string("cam0/data.csv") + line));
  }
  EXPECT_EQ(images, 2) << "that of a negative time, which the validator refuses, and the last";
}

TEST_F(AslFolder, AFolderWithoutSensorsIsAnErrorWithTheMissingFile) {
  fs::remove(root_ / "mav0/imu0/data.csv");
  try {
    const AslSource source(root_);
    FAIL();
  } catch (const std::runtime_error& error) {
    EXPECT_THAT(error.what(), HasSubstr("imu0/data.csv"));
  }
}

TEST(LogSourceTest, PassesSensorsOnAndLeavesTheServicesOutputOut) {
  const fs::path file = fs::path(testing::TempDir()) / "sensors.lcm";
  {
    LogWriter writer(file);
    imu_t imu{};
    imu.utime = 1;
    writer.write(1, "IMU", imu);
    writer.write(2, "NAV_STATE", imu);
    writer.write(3, "IMU", "garbage", 7);
    compass_t compass{};
    compass.utime = 4;
    writer.write(4, "COMPASS", compass);
  }
  LogSource source(file);
  const auto first = source.next(), second = source.next(), third = source.next();
  ASSERT_TRUE(first && second && third);
  EXPECT_TRUE(std::holds_alternative<imu_t>(*first->message));
  EXPECT_FALSE(second->message.has_value());
  EXPECT_THAT(second->error, HasSubstr("channel IMU at 3"));
  EXPECT_EQ(utime_of(*third->message), 4);
  EXPECT_STREQ(channel_of(*third->message), "COMPASS");
  EXPECT_FALSE(source.next().has_value());
}

}  // namespace
}  // namespace orthonav::ingest
