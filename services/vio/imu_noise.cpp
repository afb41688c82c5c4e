#include "services/vio/imu_noise.h"

#include <algorithm>
#include <cmath>

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

void ImuNoiseMeter::learn(const ImuVariances& heard, double share) {
  constexpr double kMostVariance = 2500;  // fifty times the data sheet's noise: another sensor than it was written for
  const auto follow = [&](double& variance, double value) {
    if (!std::isfinite(value)) return;
    variance = std::clamp(variance + share * (value - variance), 1.0, kMostVariance);
  };
  follow(variances_.gyro, heard.gyro);
  follow(variances_.accel, heard.accel);
  variances_.accel = std::max(variances_.accel, variances_.gyro);
}

}  // namespace orthonav::vio
