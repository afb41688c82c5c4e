#include "services/registration/known_scale.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "services/registration/scale_of_way.h"

namespace orthonav::registration {
namespace {

constexpr double kLargestStddev = 0.1;  // that is searched for: twice as much is off at most
// Of what it was, over some ten keyframes: where the share of aligned points falls below this the scale may have
// changed.
constexpr double kFewer = 0.5, kFewerMemory = 0.1;

}  // namespace

ScaleBelief with_odometry(const ScaleBelief& measured, double odometry_stddev) {
  // Sums over the scales that the measurement leaves, fine enough for the narrower of the two.
  constexpr double kReach = 6;  // standard deviations
  constexpr int kMostSteps = 2000;
  const double from = std::min(-kReach * odometry_stddev, measured.log_scale - kReach * measured.stddev);
  const double to = std::max(kReach * odometry_stddev, measured.log_scale + kReach * measured.stddev);
  const double wanted = (to - from) / (0.25 * std::min(odometry_stddev, measured.stddev));
  const int steps = static_cast<int>(std::clamp(wanted, 1.0, static_cast<double>(kMostSteps)));
  double sum = 0, first = 0, second = 0;
  for (int i = 0; i <= steps; ++i) {
    const double log_scale = from + (to - from) * i / steps;
    const double off = (log_scale - measured.log_scale) / measured.stddev;
    // As wide as a Gaussian of that deviation where both are highest.
    const double said = log_scale / odometry_stddev;
    const double density = std::exp(-0.5 * off * off) / (1 + 0.5 * said * said);
    sum += density;
    first += density * log_scale;
    second += density * log_scale * log_scale;
  }
  const double mean = first / sum;
  return {mean, std::sqrt(std::max(1e-12, second / sum - mean * mean))};
}

KnownScale::KnownScale(double least_stddev, double widening, int most_misses)
    : least_stddev_(least_stddev),
      widening_(widening),
      most_misses_(most_misses),
      odometry_stddev_(std::numeric_limits<double>::quiet_NaN()) {
  expect();
}

void KnownScale::forget() {
  way_.reset();
  odometry_stddev_ = std::numeric_limits<double>::quiet_NaN();
  forget_fixes();
}

void KnownScale::forget_fixes() {
  fitted_.reset();
  expect();
}

void KnownScale::hear(double odometry_stddev) {
  odometry_stddev_ = odometry_stddev;
  expect();
}

void KnownScale::saw(double aligned_share) {
  aligned_of_late_ = aligned_share;
  aligned_ += kFewerMemory * (aligned_of_late_ - aligned_);
}

void KnownScale::missed() {
  way_.reset();
  ++misses_;
  expect();
}

void KnownScale::learn(const FittedPose& pose) {
  misses_ = 0;
  fitted_ = {std::log(pose.scale), pose.scale_stddev / pose.scale};
  expect();
}

void KnownScale::ask_the_way(const std::vector<const View*>& views, size_t fitted, double spacing, const PlaceFit& fit,
                             const MapIndex& index, const EvidenceOptions& options) {
  const Eigen::Vector3d& p_W_B = views.front()->keyframe.p_W_B;
  const bool known = way_ && agree(*way_, fit.scale);
  if (known && (p_W_B - way_asked_).head<2>().norm() < spacing) return;
  way_asked_ = p_W_B;
  way_ = scale_of_way(views, fitted, fit, index, options);
}

double KnownScale::searched_stddev(bool everywhere, bool taught) const {
  // On the whole map more scales would be more chances for a wrong place.
  if (everywhere) return fitted_ ? kLeastStddev : least_stddev_;
  if (!taught || may_have_changed()) return kLargestStddev;
  return std::clamp(expected_.stddev, kLeastStddev, kLargestStddev);
}

// Where no way says better the matches are left to say what they say. That they have become few may be the scale's
// fault.
ScaleBelief KnownScale::before_fit() const {
  if (!way_ || may_have_changed()) return {expected_.log_scale, kLargestStddev};
  return with_odometry(*way_, odometry_stddev());
}

ScaleBelief KnownScale::after_fit(const PlaceFit& fit) const {
  return with_odometry(way_ ? both(*way_, fit.scale) : fit.scale, odometry_stddev());
}

bool KnownScale::may_have_changed() const {
  return aligned_of_late_ < kFewer * aligned_;
}

double KnownScale::odometry_stddev() const {
  return std::isfinite(odometry_stddev_) ? std::max(odometry_stddev_, least_stddev_) : least_stddev_;
}

// Where nothing was found of late the scale is as doubtful as the place, and the odometry says as much as the last fix.
void KnownScale::expect() {
  if (!fitted_) {
    expected_ = {0, kLargestStddev};
    return;
  }
  const double doubt = std::pow(widening_, std::min(misses_, most_misses_));
  expected_ = with_odometry({fitted_->log_scale, doubt * fitted_->stddev}, odometry_stddev());
}

}  // namespace orthonav::registration
