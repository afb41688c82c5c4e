// Whose noise it is: residuals that the sensor's own scatter bears out are its, others are not.
#include "services/vio/imu_noise.h"

#include <cmath>
#include <random>

#include <gtest/gtest.h>

namespace orthonav::vio {
namespace {

using Vector15 = ImuNoiseMeter::Vector15;

// Ten seconds of a slow motion with white noise of so many times the data sheet's.
std::vector<ImuSample> samples(double gyro_times, double accel_times) {
  constexpr double kStep = 0.005;
  const ImuNoise sheet;
  std::mt19937 generator(1);
  std::normal_distribution<double> normal;
  const auto draw = [&] { return Eigen::Vector3d(normal(generator), normal(generator), normal(generator)); };
  std::vector<ImuSample> result;
  for (int k = 0; k < 2000; ++k) {
    const double t = k * kStep;
    ImuSample sample;
    sample.utime = 1'000'000 + static_cast<int64_t>(std::llround(1e6 * t));
    sample.gyro =
        Eigen::Vector3d::Constant(0.3 * std::sin(3 * t)) + gyro_times * sheet.gyro_noise / std::sqrt(kStep) * draw();
    sample.accel =
        Eigen::Vector3d(std::sin(2 * t), 0, 9.81) + accel_times * sheet.accel_noise / std::sqrt(kStep) * draw();
    result.push_back(sample);
  }
  return result;
}

ImuVariances after(const std::vector<ImuSample>& seen, const ImuVariances& heard) {
  ImuNoiseMeter meter;
  meter.see(seen, {});
  meter.learn(heard, 1);
  return meter.variances();
}

TEST(ImuNoiseMeter, LearnsWhatBothResidualsAndScatterSay) {
  const ImuVariances learnt = after(samples(10, 10), {95, 1});
  EXPECT_NEAR(learnt.gyro, 95, 1e-9);
  EXPECT_NEAR(learnt.accel, 95, 1e-9) << "what pictures do not show is as far from the sheet as the gyroscope";
}

TEST(ImuNoiseMeter, BelievesNoMoreThanTheSamplesScatterBy) {
  const ImuVariances of_pictures = after(samples(1, 1), {2500, 2500});
  EXPECT_LT(of_pictures.gyro, 1.2);
  EXPECT_LT(of_pictures.accel, 1.2);
  const ImuVariances noisier = after(samples(3, 1), {2500, 1});
  EXPECT_NEAR(noisier.gyro, 9, 1);
  EXPECT_LT(noisier.accel, 1.2);
}

TEST(ImuNoiseMeter, VibrationsAloneMakeNoNoise) {
  const ImuVariances learnt = after(samples(20, 20), {1, 1});
  EXPECT_EQ(learnt, ImuVariances());
}

TEST(ImuNoiseMeter, NeverGoesBelowTheDataSheet) {
  EXPECT_EQ(after(samples(1, 1), {0.01, 0.01}), ImuVariances());
}

TEST(ImuNoiseMeter, HearsNothingWhereNothingIsKnown) {
  const ImuVariances with{7, 5};
  const ImuVariances heard = ImuNoiseMeter::heard(Vector15::Zero(), Vector15::Ones(), with);
  EXPECT_NEAR(heard.gyro, with.gyro, 1e-12);
  EXPECT_NEAR(heard.accel, with.accel, 1e-12);
}

TEST(ImuNoise, IsSaidWhereItIsFarFromTheDataSheets) {
  EXPECT_EQ(notice_of({1, 1}), "");
  EXPECT_EQ(notice_of({4, 8}), "");
  EXPECT_EQ(notice_of({100, 1}), "the gyroscope is 10 times as noisy as imu.gyro_noise says");
  EXPECT_EQ(notice_of({25, 100}),
            "the gyroscope is 5 times as noisy as imu.gyro_noise says, the accelerometer is 10 times as noisy as "
            "imu.accel_noise says");
}

}  // namespace
}  // namespace orthonav::vio
