#include "services/registration/ground_level.h"

#include <algorithm>
#include <array>
#include <cmath>

#include "common/math/statistics.h"

namespace orthonav::registration {
namespace {

constexpr double kStep = 0.25;  // m between the levels compared,
constexpr int kReach = 160;     // of which there are so many on either side of the first
// Of the height: the way over which what was known is forgotten, and that at which a keyframe sees ground that the one
// before did not; what lies between keyframes that are further apart was not seen.
constexpr double kMemory = 1.5, kSeenAtOnce = 0.2;
constexpr int kEnoughLifts = 10;  // on the ground, to do without what was known

// How tall trees are, and how far a wood reaches: the first 43 m of a flight over one were 12 m too low.
constexpr double kHidden = 12, kWood = 50;  // m

// A lift around the level: on the ground, of a point on something as tall as houses and trees are, or wrong.
constexpr double kOnGround = 0.62, kAbove = 0.37, kWrong = 0.01;
constexpr double kTallest = 40;      // m
constexpr double kWrongRange = 150;  // m

double log_density(double above_ground, double stddev) {
  const double z = above_ground / stddev;
  double density = kWrong / kWrongRange + kOnGround / (std::sqrt(2 * M_PI) * stddev) * std::exp(-0.5 * z * z);
  if (above_ground > 0 && above_ground < kTallest) density += kAbove / kTallest;
  return std::log(density);
}

}  // namespace

void GroundLevel::add(const std::vector<double>& lifts, double height, const Eigen::Vector3d& p_W_B,
                      double lifts_per_observation) {
  if (log_likelihoods_.empty()) {
    origin_ = median(lifts);
    log_likelihoods_.assign(2 * kReach + 1, 0.0);
  } else {
    const Eigen::Vector3d moved = p_W_B - p_W_B_;
    const double step = moved.head<2>().norm();
    const double seen = std::min(step, kSeenAtOnce * height);
    origin_ += moved.z();
    way_ += seen;
    // Keyframes side by side see the same trees.
    lifts_per_observation *= kSeenAtOnce * height / std::max(seen, 1e-3 * height);
    for (double& log_likelihood : log_likelihoods_) log_likelihood *= std::exp(-step / (kMemory * height));
  }
  p_W_B_ = p_W_B;
  // Of the odometry's depths and the map's heights.
  const double stddev = std::hypot(0.7, 0.01 * height);
  for (size_t i = 0; i < log_likelihoods_.size(); ++i) {
    const double level = origin_ + kStep * (static_cast<double>(i) - kReach);
    double sum = 0;
    for (const double lift : lifts) sum += log_density(level - lift, stddev);
    log_likelihoods_[i] += sum / lifts_per_observation;
  }
  const auto best = std::max_element(log_likelihoods_.begin(), log_likelihoods_.end());
  const double mode = origin_ + kStep * static_cast<double>(best - log_likelihoods_.begin() - kReach);
  double sum = 0;
  int count = 0;
  for (const double lift : lifts) {
    if (std::abs(lift - mode) > 2 * stddev) continue;
    sum += lift;
    ++count;
  }
  level_ = (sum + std::max(0, kEnoughLifts - count) * mode) / std::max(kEnoughLifts, count);
}

double GroundLevel::hidden_stddev() const {
  return kHidden * std::exp(-0.5 * (way_ / kWood) * (way_ / kWood));
}

}  // namespace orthonav::registration
