#include "services/registration/submap/known_scale.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "services/registration/submap/scale_of_way.h"

namespace orthonav::registration {
namespace {

constexpr double kLargestStddev = 0.1;  // that is searched for: twice as much is off at most
// Of what it was, over some ten keyframes: where the share of aligned points falls below this the scale may have
// changed.
constexpr double kFewer = 0.5, kFewerMemory = 0.1;
// No odometry is off by more: a belief that reaches further is cut there.
const double kLargestLog = std::log(2);

}  // namespace

ScaleBelief with_odometry(const ScaleBelief& measured, double odometry_stddev) {
  // Sums over the scales that the measurement leaves, fine enough for the narrower of the two.
  constexpr double kReach = 6;  // standard deviations
  constexpr int kMostSteps = 2000;
  const double centre = std::clamp(measured.log_scale, -kLargestLog, kLargestLog);
  const double from = std::max(-kLargestLog, std::min(-kReach * odometry_stddev, centre - kReach * measured.stddev));
  const double to = std::min(kLargestLog, std::max(kReach * odometry_stddev, centre + kReach * measured.stddev));
  const double wanted = (to - from) / (0.25 * std::min(odometry_stddev, measured.stddev));
  const int steps = static_cast<int>(std::clamp(wanted, 1.0, static_cast<double>(kMostSteps)));
  double sum = 0, first = 0, second = 0;
  for (int i = 0; i <= steps; ++i) {
    const double log_scale = from + (to - from) * i / steps;
    const double off = (log_scale - centre) / measured.stddev;
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

KnownScale::KnownScale(double usual_stddev, double widening, int most_misses)
    : usual_stddev_(usual_stddev),
      widening_(widening),
      most_misses_(most_misses),
      odometry_stddev_(std::numeric_limits<double>::quiet_NaN()) {
  expect();
}

void KnownScale::forget() {
  way_.reset();
  way_asked_.reset();
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
  way_asked_.reset();
  ++misses_;
  expect();
}

void KnownScale::learn(const PlaceFit& fit) {
  misses_ = 0;
  fitted_ = measured(fit);
  expect();
}

void KnownScale::ask_the_way(const std::vector<const View*>& views, size_t fitted, double spacing, const PlaceFit& fit,
                             const MapIndex& index, const EvidenceOptions& evidence, const FitOptions& options) {
  const Eigen::Vector2d p_W_B = views.front()->keyframe.p_W_B.head<2>();
  const bool contradicted = way_ && !agree(*way_, fit.scale);
  if (way_asked_ && !contradicted && (p_W_B - *way_asked_).norm() < spacing) return;
  way_asked_ = p_W_B;
  way_ = scale_of_way(views, fitted, fit, index, evidence, options);
}

double KnownScale::searched_stddev(bool everywhere, bool taught) const {
  // On the whole map more scales would be more chances for a wrong place.
  if (everywhere) return fitted_ ? kLeastStddev : usual_stddev_;
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
  return with_odometry(measured(fit), odometry_stddev());
}

bool KnownScale::may_have_changed() const {
  return aligned_of_late_ < kFewer * aligned_;
}

double KnownScale::odometry_stddev() const {
  // It says so of its newest stretch; NaN: unknown.
  return odometry_stddev_ > 0 ? std::max(odometry_stddev_, kLeastStddev) : usual_stddev_;
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
