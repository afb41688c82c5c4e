#include "services/registration/submap/ground_level.h"

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
// The way over which the level is averaged, m: elevation models err over some hundred, the odometry's climb over more.
// At first, a share of what was flown: the first keyframes' depths are the worst, and would be held on to.
// What differs from the average by more is another ground, and it begins anew, m.
// Where little way is flown a keyframe counts as much as one after so many metres.
constexpr double kAveraged = 200, kShareAveraged = 0.4, kAnew = 2.5, kLeastStep = 1;
// What such an average errs by, m.
constexpr double kMean = 0.7;

// How tall trees are, and how far a wood reaches: the first 43 m of a flight over one were 12 m too low.
constexpr double kHidden = 12, kWood = 50;  // m

// A lift around the level: on the ground, of a point on something as tall as houses and trees are, or wrong.
constexpr double kOnGround = 0.62, kAbove = 0.37, kWrong = 0.01;
constexpr double kTallest = 40;      // m
constexpr double kWrongRange = 150;  // m

constexpr double kFurthest = 6;  // standard deviations beyond which the ground's own density is nothing

// What a lift errs by, m: the map's heights from place to place, and the odometry's vertical (0.3 degrees) over the
// points' distances. Depths are known to 0.0003-0.0005 of the height. Taken for five times as much, what is low
// (houses, bushes) was ground, and levels were 1-2 m too low at 285 m.
double stddev_at(double height) {
  return std::hypot(0.7, 0.002 * height);
}

// Of levels kStep apart, the first at `lowest`: multiplies `densities` by those of one lift.
void multiply(double lift, double lowest, double stddev, std::array<double, 2 * kReach + 1>& densities) {
  const auto first_above = [&](double above_ground) {
    const double level = std::ceil((lift + above_ground - lowest) / kStep);
    return static_cast<size_t>(std::clamp(level, 0.0, static_cast<double>(densities.size())));
  };
  const size_t ground = first_above(-kFurthest * stddev), above = first_above(kFurthest * stddev);
  const size_t zero = first_above(0), tallest = std::max(zero, first_above(kTallest));
  constexpr double kBase = kWrong / kWrongRange, kRaised = kBase + kAbove / kTallest;
  std::array<double, 2 * kReach + 1> density;  // NOLINT: filled below
  std::fill(density.begin(), density.begin() + zero, kBase);
  std::fill(density.begin() + zero, density.begin() + tallest, kRaised);
  std::fill(density.begin() + tallest, density.end(), kBase);
  // The Gaussian from level to level: its logarithm is quadratic, so the ratio of neighbours changes by a factor.
  const double step = kStep / stddev;
  const double z = (lowest + kStep * static_cast<double>(ground) - lift) / stddev;
  double value = kOnGround / (std::sqrt(2 * M_PI) * stddev) * std::exp(-0.5 * z * z);
  double ratio = std::exp(-step * (z + 0.5 * step));
  const double change = std::exp(-step * step);
  for (size_t i = ground; i < above; ++i, value *= ratio, ratio *= change) density[i] += value;
  for (size_t i = 0; i < density.size(); ++i) densities[i] *= density[i];
}

// Of log-likelihoods of levels that all may be off by the same, `stddev` m.
void blur(double stddev, std::vector<double>& log_likelihoods) {
  if (stddev < kStep) return;
  const int size = static_cast<int>(log_likelihoods.size());
  const int reach = std::min(size, static_cast<int>(kFurthest * stddev / kStep));
  const double curvature = 0.5 * kStep * kStep / (stddev * stddev);
  const std::vector<double> sharp = log_likelihoods;
  for (int i = 0; i < size; ++i) {
    double& most = log_likelihoods[static_cast<size_t>(i)];
    for (int j = std::max(0, i - reach); j <= std::min(size - 1, i + reach); ++j) {
      most = std::max(most, sharp[static_cast<size_t>(j)] - curvature * (i - j) * (i - j));
    }
  }
}

}  // namespace

void GroundLevel::add(const std::vector<double>& lifts, double height, const Eigen::Vector3d& p_W_B,
                      double lifts_per_observation, const ScaleBelief& scale) {
  const Eigen::Vector3d moved =
      known() ? Eigen::Vector3d(std::exp(scale.log_scale) * (p_W_B - p_W_B_)) : Eigen::Vector3d::Zero();
  const double middle = median(lifts);
  origin_ += moved.z();
  // What is seen now lies at none of the levels compared: what is remembered is of no use to it.
  if (std::abs(middle - origin_) > kStep * kReach) *this = {};
  double step = 0;
  if (!known()) {
    origin_ = middle;
    scale_ = scale;
    log_likelihoods_.assign(2 * kReach + 1, 0.0);
  } else {
    step = moved.head<2>().norm();
    const double seen = std::min(step, kSeenAtOnce * height);
    level_ += moved.z();
    way_ += seen;
    averaged_ *= std::exp(-step / kAveraged);
    // Keyframes side by side see the same trees.
    lifts_per_observation *= kSeenAtOnce * height / std::max(seen, 1e-3 * height);
    for (double& log_likelihood : log_likelihoods_) log_likelihood *= std::exp(-step / (kMemory * height));
    const double changed = scale.log_scale - scale_.log_scale;
    const double said = std::hypot(scale.stddev, scale_.stddev);
    const double beyond = std::sqrt(std::max(0.0, changed * changed - said * said));
    if (beyond > 0) {
      const double off = height * beyond;
      blur(off, log_likelihoods_);
      averaged_ /= 1 + averaged_ * off * off / (kAveraged * kMean * kMean);
      scale_ = scale;
    }
    const double share = std::min(1.0, std::max(kLeastStep, step) / (kMemory * height));
    scale_.log_scale += share * (scale.log_scale - scale_.log_scale);
    scale_.stddev += share * (scale.stddev - scale_.stddev);
  }
  p_W_B_ = p_W_B;
  const double stddev = stddev_at(height);
  std::vector<double> seen(log_likelihoods_.size(), 0.0);
  // Products of the densities, for a logarithm takes as long as many of them; 64 of at least 6e-5 are not too small.
  constexpr size_t kProduct = 64;
  for (size_t first = 0; first < lifts.size(); first += kProduct) {
    std::array<double, 2 * kReach + 1> densities;  // NOLINT: filled below
    densities.fill(1);
    for (size_t i = first; i < std::min(lifts.size(), first + kProduct); ++i) {
      multiply(lifts[i], origin_ - kStep * kReach, stddev, densities);
    }
    for (size_t i = 0; i < densities.size(); ++i) {
      seen[i] += std::log(densities[i]) / lifts_per_observation;
    }
  }
  blur(scale.stddev * height, seen);
  for (size_t i = 0; i < seen.size(); ++i) log_likelihoods_[i] += seen[i];
  const auto best = std::max_element(log_likelihoods_.begin(), log_likelihoods_.end());
  const double mode = origin_ + kStep * static_cast<double>(best - log_likelihoods_.begin() - kReach);
  double sum = 0;
  int count = 0;
  for (const double lift : lifts) {
    if (std::abs(lift - mode) > 2 * stddev) continue;
    sum += lift;
    ++count;
  }
  const double here = (sum + std::max(0, kEnoughLifts - count) * mode) / std::max(kEnoughLifts, count);
  if (std::abs(here - level_) > kAnew) averaged_ = 0;
  const double by_scale = scale.stddev * height / kMean;
  const double counts = std::max(kLeastStep, std::min(step, kSeenAtOnce * height)) / (1 + by_scale * by_scale);
  averaged_ = std::clamp(averaged_ + counts, counts, std::max(counts, std::min(kAveraged, kShareAveraged * way_)));
  level_ += (here - level_) * counts / averaged_;
}

GroundLevel::Above GroundLevel::above(double rise, double height) {
  // Gaussian errors; on the ground, or evenly up to as high as trees are.
  const double stddev = stddev_at(height);
  const double z = rise / stddev;
  const double density = std::exp(-0.5 * z * z) / std::sqrt(2 * M_PI);
  const double positive = 0.5 * std::erfc(-z / std::sqrt(2.0));
  const double ground = kOnGround * density / stddev;
  const double something = kAbove / kTallest * positive;
  const double all = ground + something + kWrong / kWrongRange;
  return {kAbove / kTallest * std::max(0.0, rise * positive + stddev * density) / all, ground / all, something / all};
}

double GroundLevel::hidden_stddev() const {
  return kHidden * std::exp(-0.5 * (way_ / kWood) * (way_ / kWood));
}

}  // namespace orthonav::registration
