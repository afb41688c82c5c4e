#include "services/vio/bearing_rates.h"

#include <algorithm>

#include "common/math/so3.h"
#include "common/math/statistics.h"

namespace orthonav::vio {

bool BearingRates::see(const std::vector<TrackedFeature>& features, const std::vector<ImuSample>& imu,
                       const Extrinsics& extrinsics, const Eigen::Vector3d& gyro_bias) {
  const Eigen::Matrix3d R_C_B = extrinsics.R_B_C.transpose();
  Eigen::Vector3d turn = Eigen::Vector3d::Zero();  // since the previous image
  double dt = 0;
  for (size_t k = 1; k < imu.size(); ++k) {
    const double step = 1e-6 * static_cast<double>(imu[k].utime - imu[k - 1].utime);
    turn += step * (R_C_B * (0.5 * (imu[k].gyro + imu[k - 1].gyro) - gyro_bias));
    dt += step;
  }
  turn_rate_.setZero();
  if (!imu.empty()) turn_rate_ = R_C_B * (imu.back().gyro - gyro_bias);

  const bool first = sights_.empty();
  const Eigen::Matrix3d R_now_before = so3_exp(turn).toRotationMatrix().transpose();
  std::map<int64_t, Sight> seen;
  std::vector<double> u, v;
  for (const TrackedFeature& feature : features) {
    Sight sight{feature.ray, Eigen::Vector2d::Zero(), 0, Eigen::Vector2d::Zero()};
    const auto before = sights_.find(feature.id);
    if (before != sights_.end() && dt > 0) {
      constexpr double kNewest = 0.2;  // weight of the newest of many differences
      const Eigen::Vector3d turned = R_now_before * before->second.ray;
      const Eigen::Vector2d difference = (feature.ray.head<2>() - turned.head<2>() / turned.z()) / dt;
      sight.differences = before->second.differences + 1;
      sight.earlier = before->second.drift;
      const double weight = std::max(kNewest, 1.0 / sight.differences);
      sight.drift = (1 - weight) * before->second.drift + weight * difference;
      u.push_back(difference.x());
      v.push_back(difference.y());
    }
    seen[feature.id] = sight;
  }
  // One that has no history moves as the others do.
  const Eigen::Vector2d usual = u.empty() ? Eigen::Vector2d::Zero() : Eigen::Vector2d(median(u), median(v));
  for (auto& [id, sight] : seen) {
    if (sight.differences < 2) sight.earlier = usual;
  }
  sights_ = std::move(seen);
  return !first;
}

Eigen::Vector2d BearingRates::by_rotation(const Eigen::Vector3d& ray) const {
  const Eigen::Vector3d moved = -turn_rate_.cross(ray);
  return moved.head<2>() - ray.head<2>() * moved.z();
}

Eigen::Vector2d BearingRates::by_differences(const TrackedFeature& feature) const {
  return by_rotation(feature.ray) + sights_.at(feature.id).earlier;
}

Eigen::Vector2d BearingRates::by_motion(const TrackedFeature& feature, const Eigen::Vector3d& velocity_C,
                                        double inverse_depth) const {
  return by_rotation(feature.ray) - inverse_depth * (velocity_C.head<2>() - feature.ray.head<2>() * velocity_C.z());
}

}  // namespace orthonav::vio
