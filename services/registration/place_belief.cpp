#include "services/registration/place_belief.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace orthonav::registration {
namespace {

// Standard deviations within which two places are one.
constexpr double kGate = 3;
// What is less probable than this cannot become sure before it is found anew.
constexpr double kNegligible = 1e-6;
constexpr size_t kMost = 16;

bool agree(const PlaceHypothesis& a, const Eigen::Vector2d& en, double stddev) {
  return (a.en - en).norm() <= kGate * std::hypot(a.stddev, stddev);
}

}  // namespace

void PlaceBelief::clear() {
  hypotheses_.clear();
}

void PlaceBelief::carry(const Eigen::Vector2d& p_W, double way_stddev) {
  const Eigen::Vector2d way = p_W - p_W_;
  p_W_ = p_W;
  for (PlaceHypothesis& each : hypotheses_) {
    const Eigen::Vector2d moved = each.G_W * way;
    each.en += moved;
    each.stddev = std::hypot(each.stddev, way_stddev * moved.norm());
  }
}

void PlaceBelief::suppose(const Eigen::Vector2d& en, const Eigen::Matrix2d& G_W, double stddev, double log_odds) {
  if (const PlaceHypothesis* known = agreeing(en, stddev)) {
    const int64_t id = known->id;
    find(id)->log_odds = log_odds;
    correct(id, en, G_W, stddev);
    return;
  }
  hypotheses_.push_back({++newest_, en, G_W, stddev, log_odds});
}

void PlaceBelief::correct(int64_t id, const Eigen::Vector2d& en, const Eigen::Matrix2d& G_W, double stddev) {
  PlaceHypothesis* each = find(id);
  if (each == nullptr) return;
  const double of_it = each->stddev * each->stddev, of_place = stddev * stddev;
  each->en += of_it / (of_it + of_place) * (en - each->en);
  each->stddev = std::sqrt(of_it * of_place / (of_it + of_place));
  each->G_W = G_W;
}

void PlaceBelief::settle() {
  std::stable_sort(hypotheses_.begin(), hypotheses_.end(),
                   [](const PlaceHypothesis& a, const PlaceHypothesis& b) { return a.log_odds > b.log_odds; });
  std::vector<PlaceHypothesis> kept;
  for (const PlaceHypothesis& each : hypotheses_) {
    const auto same = [&](const PlaceHypothesis& other) { return agree(other, each.en, each.stddev); };
    if (std::none_of(kept.begin(), kept.end(), same)) kept.push_back(each);
  }
  hypotheses_ = std::move(kept);
  const double all = log_others(0);
  const auto negligible = [&](const PlaceHypothesis& each) { return each.log_odds - all < std::log(kNegligible); };
  hypotheses_.erase(std::find_if(hypotheses_.begin(), hypotheses_.end(), negligible), hypotheses_.end());
  if (hypotheses_.size() > kMost) hypotheses_.resize(kMost);
}

const PlaceHypothesis* PlaceBelief::find(int64_t id) const {
  const auto found =
      std::find_if(hypotheses_.begin(), hypotheses_.end(), [id](const PlaceHypothesis& each) { return each.id == id; });
  return found == hypotheses_.end() ? nullptr : &*found;
}

PlaceHypothesis* PlaceBelief::find(int64_t id) {
  return const_cast<PlaceHypothesis*>(std::as_const(*this).find(id));  // NOLINT: its own
}

const PlaceHypothesis* PlaceBelief::agreeing(const Eigen::Vector2d& en, double stddev) const {
  const PlaceHypothesis* best = nullptr;
  for (const PlaceHypothesis& each : hypotheses_) {
    if (agree(each, en, stddev) && (best == nullptr || each.log_odds > best->log_odds)) best = &each;
  }
  return best;
}

double PlaceBelief::log_others(int64_t id) const {
  double most = 0;
  for (const PlaceHypothesis& each : hypotheses_) {
    if (each.id != id) most = std::max(most, each.log_odds);
  }
  double sum = std::exp(-most);
  for (const PlaceHypothesis& each : hypotheses_) {
    if (each.id != id) sum += std::exp(each.log_odds - most);
  }
  return most + std::log(sum);
}

double PlaceBelief::log_odds(int64_t id) const {
  const PlaceHypothesis* each = find(id);
  return each == nullptr ? -std::numeric_limits<double>::infinity() : each->log_odds - log_others(id);
}

double PlaceBelief::probability(int64_t id) const {
  return 1 / (1 + std::exp(-log_odds(id)));
}

double PlaceBelief::log_odds_at(const Eigen::Vector2d& en, double stddev) const {
  const PlaceHypothesis* each = agreeing(en, stddev);
  return each == nullptr ? std::log(kNegligible) : log_odds(each->id);
}

double PlaceBelief::none() const {
  return std::exp(-log_others(0));
}

}  // namespace orthonav::registration
