#include "services/fusion/protection.h"

#include <algorithm>
#include <cmath>

namespace orthonav::fusion {
namespace {

// Reach of a hypothesis: how far the position given out can be from the truth if the hypothesis holds.
Protection reach(const Located& given, const Located& hypothesis) {
  const Eigen::Vector3d offset = given.p_G_B - hypothesis.p_G_B;
  return {offset.head<2>().norm() + kHorizontalQuantile * horizontal_stddev(hypothesis.covariance),
          std::abs(offset.z()) + kVerticalQuantile * std::sqrt(hypothesis.covariance(2, 2))};
}

void widen(Protection& level, const Protection& other) {
  level.horizontal = std::max(level.horizontal, other.horizontal);
  level.vertical = std::max(level.vertical, other.vertical);
}

}  // namespace

double horizontal_stddev(const Eigen::Matrix3d& covariance) {
  const double mean = 0.5 * (covariance(0, 0) + covariance(1, 1));
  const double half = 0.5 * (covariance(0, 0) - covariance(1, 1));
  return std::sqrt(mean + std::hypot(half, covariance(0, 1)));
}

Protection protect(const Located& given, const Located& without_newest, const std::optional<Located>& rival) {
  Protection level = reach(given, given);
  widen(level, reach(given, without_newest));
  if (rival) widen(level, reach(given, *rival));
  return level;
}

Protection carried_on(const Protection& level, const Eigen::Matrix3d& then, const Eigen::Matrix3d& now) {
  const auto grown = [](double l, double quantile, double sigma_then, double sigma_now) {
    const double growth = std::max(0.0, sigma_now * sigma_now - sigma_then * sigma_then);
    return std::sqrt(l * l + quantile * quantile * growth);
  };
  return {grown(level.horizontal, kHorizontalQuantile, horizontal_stddev(then), horizontal_stddev(now)),
          grown(level.vertical, kVerticalQuantile, std::sqrt(then(2, 2)), std::sqrt(now(2, 2)))};
}

}  // namespace orthonav::fusion
