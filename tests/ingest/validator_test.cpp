#include "services/ingest/validator.h"

#include <limits>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

namespace orthonav::ingest {
namespace {

imu_t imu_at(int64_t utime) {
  imu_t imu{};
  imu.utime = utime;
  imu.specific_force[2] = 9.81;
  return imu;
}

image_t grey_image(int64_t utime, int width, int height) {
  image_t image;
  image.utime = utime;
  image.width = image.row_stride = width;
  image.height = height;
  image.pixelformat = image_t::PIXEL_FORMAT_GRAY;
  image.size = width * height;
  image.data.resize(static_cast<size_t>(image.size));
  image.nmetadata = 0;
  return image;
}

TEST(Validator, AcceptsAnOrderlyStreamAndMeasuresItsRate) {
  Validator validator;
  for (int i = 1; i <= 400; ++i) EXPECT_TRUE(validator.check(imu_at(i * 5000)).accepted);
  EXPECT_NEAR(validator.rate_hz("IMU"), 200, 1e-6);
  EXPECT_EQ(validator.rate_hz("CAMERA"), 0);
}

TEST(Validator, RefusesNaN) {
  Validator validator;
  for (int axis = 0; axis < 3; ++axis) {
    imu_t imu = imu_at(1000);
    imu.angular_rate[axis] = std::numeric_limits<double>::quiet_NaN();
    const Verdict verdict = validator.check(imu);
    EXPECT_FALSE(verdict.accepted);
    EXPECT_EQ(verdict.reason, "nan");
    EXPECT_THAT(verdict.detail, testing::HasSubstr("IMU at 1000"));
    imu = imu_at(1000);
    imu.specific_force[axis] = std::numeric_limits<double>::infinity();
    EXPECT_FALSE(validator.check(imu).accepted);
  }
  compass_t compass{};
  compass.utime = 1;
  compass.heading = std::numeric_limits<double>::quiet_NaN();
  EXPECT_EQ(validator.check(compass).reason, "nan");
}

TEST(Validator, RefusesWhatNoSensorOfASmallAircraftReads) {
  Validator validator;
  imu_t imu = imu_at(1000);
  imu.angular_rate[1] = -200;
  EXPECT_EQ(validator.check(imu).reason, "range");
  imu = imu_at(1000);
  imu.specific_force[0] = 1e5;
  EXPECT_EQ(validator.check(imu).reason, "range");
  magnetometer_t field{};
  field.utime = 1000;
  field.field[2] = 0.1;
  EXPECT_EQ(validator.check(field).reason, "range");
  compass_t compass{};
  compass.utime = 1000;
  compass.heading = 360;
  EXPECT_EQ(validator.check(compass).reason, "range") << "degrees are no radians";
  altitude_t altitude{};
  altitude.utime = 1000;
  altitude.height_above_ground = 1e9;
  EXPECT_EQ(validator.check(altitude).reason, "range");
}

TEST(Validator, RefusesTimeThatDoesNotAdvancePerChannel) {
  Validator validator;
  EXPECT_TRUE(validator.check(imu_at(10'000)).accepted);
  EXPECT_EQ(validator.check(imu_at(10'000)).reason, "order");
  EXPECT_EQ(validator.check(imu_at(5'000)).reason, "order");
  EXPECT_TRUE(validator.check(imu_at(15'000)).accepted) << "what was refused must not become the reference";
  EXPECT_TRUE(validator.check(grey_image(7'000, 8, 8)).accepted) << "another channel has a time of its own";
}

TEST(Validator, RefusesATimeFromTomorrowAndFollowsAClockThatStaysThere) {
  Validator validator;
  constexpr int64_t kTomorrow = 86'400'000'000;
  EXPECT_TRUE(validator.check(imu_at(5'000)).accepted);
  EXPECT_EQ(validator.check(imu_at(kTomorrow)).reason, "jump");
  EXPECT_TRUE(validator.check(imu_at(10'000)).accepted);
  int refused = 0;
  while (!validator.check(imu_at(kTomorrow + 5'000 * (refused + 1))).accepted) ASSERT_LT(++refused, 100);
  EXPECT_GT(refused, 10);
}

TEST(Validator, LetsGapsThroughAndMarksThem) {
  Validator validator;
  for (int i = 1; i <= 100; ++i) EXPECT_FALSE(validator.check(imu_at(i * 5000)).gap);
  const Verdict verdict = validator.check(imu_at(100 * 5000 + 500'000));
  EXPECT_TRUE(verdict.accepted);
  EXPECT_TRUE(verdict.gap);
}

TEST(Validator, RefusesImagesWhoseSizeDisagreesWithTheirData) {
  Validator validator;
  EXPECT_TRUE(validator.check(grey_image(1, 64, 48)).accepted);
  image_t truncated = grey_image(2, 64, 48);
  truncated.data.resize(1000);
  truncated.size = 1000;
  EXPECT_EQ(validator.check(truncated).reason, "size");
  image_t negative = grey_image(3, 64, 48);
  negative.width = -64;
  EXPECT_EQ(validator.check(negative).reason, "size");
  image_t overflowing = grey_image(4, 64, 48);
  overflowing.height = overflowing.row_stride = overflowing.width = std::numeric_limits<int32_t>::max();
  EXPECT_EQ(validator.check(overflowing).reason, "size");
  image_t unknown = grey_image(5, 64, 48);
  unknown.pixelformat = 7;
  EXPECT_EQ(validator.check(unknown).reason, "format");
}

}  // namespace
}  // namespace orthonav::ingest
