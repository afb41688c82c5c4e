#include "services/vio/imu_noise.h"

#include <algorithm>
#include <cmath>

#include <fmt/format.h>

namespace orthonav::vio {

ImuNoise ImuVariances::applied_to(ImuNoise sheet) const {
  sheet.gyro_noise *= std::sqrt(gyro);
  sheet.accel_noise *= std::sqrt(accel);
  sheet.gyro_walk *= std::sqrt(gyro);
  sheet.accel_walk *= std::sqrt(accel);
  return sheet;
}

ImuVariances ImuNoiseMeter::heard(const Vector15& residual, const Vector15& unknown,
                                  const ImuVariances& integrated_with) {
  constexpr double kMostOfOne = 25;  // a knock is no noise
  const auto part = [&](int first, double variance) {
    const double left = residual.segment<3>(first).squaredNorm() + unknown.segment<3>(first).sum();
    return variance * std::min(kMostOfOne, left / 3);
  };
  return {part(3, integrated_with.gyro), part(6, integrated_with.accel)};
}

std::string notice_of(const ImuVariances& variances) {
  constexpr double kNotable = 3;  // airframes shake a sensor by up to so much
  const double gyro = std::sqrt(variances.gyro), accel = std::sqrt(variances.accel);
  std::string notice;
  if (gyro > kNotable) notice = fmt::format("the gyroscope is {:.0f} times as noisy as imu.gyro_noise says", gyro);
  if (accel > kNotable) {
    notice += fmt::format("{}the accelerometer is {:.0f} times as noisy as imu.accel_noise says",
                          notice.empty() ? "" : ", ", accel);
  }
  return notice;
}

void ImuNoiseMeter::see(const std::vector<ImuSample>& samples, const ImuNoise& sheet) {
  constexpr double kMemory = 10000;  // differences: a minute at 200 Hz
  // Third differences leave of a motion what changes within four samples; of white noise 20 times its variance.
  constexpr double kThird = 20;
  for (size_t k = 1; k + 4 < samples.size(); ++k) {
    const ImuSample* s = &samples[k];
    const double dt = 1e-6 * static_cast<double>(s[3].utime - s[0].utime) / 3;
    if (dt <= 0) continue;
    const auto ratio = [&](const Eigen::Vector3d& difference, double noise) {
      return difference.squaredNorm() / 3 / kThird * dt / (noise * noise);
    };
    seen_ = std::min(seen_ + 1, kMemory);
    const double gyro = ratio(s[3].gyro - 3 * s[2].gyro + 3 * s[1].gyro - s[0].gyro, sheet.gyro_noise);
    const double accel = ratio(s[3].accel - 3 * s[2].accel + 3 * s[1].accel - s[0].accel, sheet.accel_noise);
    scatter_.gyro += (gyro - scatter_.gyro) / seen_;
    scatter_.accel += (accel - scatter_.accel) / seen_;
  }
}

void ImuNoiseMeter::learn(const ImuVariances& heard, double share) {
  const auto follow = [&](double& variance, double value, double scatter) {
    if (!std::isfinite(value)) return;
    variance = std::clamp(variance + share * (value - variance), 1.0, std::max(1.0, scatter));
  };
  follow(variances_.gyro, heard.gyro, scatter_.gyro);
  follow(variances_.accel, std::max(heard.accel, variances_.gyro), scatter_.accel);
}

}  // namespace orthonav::vio
