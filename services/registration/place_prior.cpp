#include "services/registration/place_prior.h"

#include <algorithm>
#include <cmath>

namespace orthonav::registration {
namespace {

// How far what the fusion expects is to be trusted: it may follow wrong fixes, or another aircraft's.
constexpr double kExpectationTrust = 0.99;

}  // namespace

double ExpectedArea::density(const Eigen::Vector2d& en) const {
  double twice_area = 0, perimeter = 0, distance = (en - corners.front()).norm();
  bool inside = false;
  for (size_t i = 0; i < corners.size(); ++i) {
    const Eigen::Vector2d& a = corners[i];
    const Eigen::Vector2d& b = corners[(i + 1) % corners.size()];
    const Eigen::Vector2d side = b - a, from_a = en - a;
    twice_area += a.x() * b.y() - a.y() * b.x();
    perimeter += side.norm();
    const double along = side.squaredNorm() > 0 ? std::clamp(from_a.dot(side) / side.squaredNorm(), 0.0, 1.0) : 0.0;
    distance = std::min(distance, (from_a - along * side).norm());
    const bool crosses = (a.y() > en.y()) != (b.y() > en.y());
    if (crosses && from_a.x() < side.x() * from_a.y() / side.y()) inside = !inside;
  }
  if (inside) distance = 0;
  // What lies around a convex area, by Steiner's formula, weighted by how it falls off.
  const double all = 0.5 * std::abs(twice_area) + perimeter * stddev * std::sqrt(M_PI / 2) + 2 * M_PI * stddev * stddev;
  return std::exp(-0.5 * distance * distance / (stddev * stddev)) / all;
}

double PlacePrior::log_probability(const Eigen::Vector2d& en) const {
  double probability = anywhere_;
  for (const ExpectedArea& each : expectations_) {
    probability = (1 - each.trust) * probability + each.trust * cell_ * each.density(en);
  }
  return std::log(probability);
}

void Expectations::carry(const Eigen::Vector2d& way, double way_stddev) {
  if (!hint_) return;
  for (Eigen::Vector2d& corner : hint_->corners) corner += way;
  hint_->stddev = std::hypot(hint_->stddev, way_stddev * way.norm());
}

void Expectations::add_to(PlacePrior& prior, double pitch) const {
  if (hint_) prior.expect(*hint_);
  if (prior_ && prior_->is_known()) prior.expect({{prior_->en}, std::hypot(prior_->stddev, pitch), kExpectationTrust});
}

}  // namespace orthonav::registration
