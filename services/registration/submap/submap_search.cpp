// The part of SubmapRegistrar that searches: under which headings and scales, around the expected place or everywhere.
#include <algorithm>
#include <cmath>

#include "common/math/so3.h"
#include "services/registration/submap/submap.h"

namespace orthonav::registration {
namespace {

// How well a fix knows the heading for the next one, rad.
constexpr double kFittedTurnStddev = 0.7 * M_PI / 180;

}  // namespace

Alignment SubmapRegistrar::expected(const View& view, size_t variant) const {
  return {wrap_angle(yaw() + turns()[variant] - view.yaw), std::exp(scale_.expected().log_scale)};
}

double SubmapRegistrar::turn_stddev(size_t variant) const {
  return fitted_yaw_            ? kFittedTurnStddev
         : is_heading_unknown() ? 0.25 * kHeadingStep
         : variant > 0          ? 0.25 * kTurnStep
                                : compass_stddev_;
}

std::vector<Alignment> SubmapRegistrar::alignments_for(size_t variant, const View& view, double lever,
                                                       double step) const {
  return alignments(expected(view, variant), turn_stddev(variant),
                    scale_.searched_stddev(std::isinf(radius_), is_taught()), lever, step);
}

void SubmapRegistrar::search(const std::optional<PositionPrior>& prior) {
  if (!refused_.empty()) return;
  expectations_.expect(prior);
  const Eigen::Vector2d size = index_->pitch() * Eigen::Vector2d(index_->columns(), index_->rows());
  radius_ = std::numeric_limits<double>::infinity();
  expected_radius_ = 0;
  if (prior && prior->is_known()) {
    expected_ = prior->en;
    expected_radius_ = std::max(options_.min_radius, options_.bound_stddevs * prior->stddev);
    const double radius = expected_radius_ * std::pow(options_.widening, std::min(widened_, 50));
    if (radius < 0.5 * size.norm()) radius_ = radius;
  }
  search_as_wide();
  // What is not where the aircraft is expected has to stand against the whole map: nearby there is little to compare
  // it with.
  if (!std::isinf(radius_) && !places_.empty() && !is_expected(places_.front().en)) {
    radius_ = std::numeric_limits<double>::infinity();
    search_as_wide();
  }
  believe();
}

void SubmapRegistrar::search_as_wide() {
  places_.clear();
  const std::vector<double> turns = this->turns();
  if (is_heading_unknown()) describe_turned(turns);
  for (size_t variant = 0; variant < turns.size(); ++variant) {
    if (variant == 1 && !is_heading_unknown()) {
      // The compass is believed where it leads to a place.
      if (std::isfinite(radius_) || is_clear()) break;
      describe_turned(turns);
    }
    if (is_nearby()) {
      search_nearby(variant);
    } else {
      search_widely(variant);
    }
    sort_places();
  }
}

void SubmapRegistrar::sort_places() {
  const auto likelier = [](const Place& a, const Place& b) { return a.likelihood > b.likelihood; };
  std::stable_sort(places_.begin(), places_.end(), likelier);
}

double SubmapRegistrar::likelihood_ratio(const Place& place, const Eigen::Vector2d& fitted) const {
  for (const Place& other : places_) {
    if ((other.en - place.en).norm() < options_.second_distance) continue;
    if ((other.en - fitted).norm() < options_.second_distance) continue;
    return place.likelihood - other.likelihood;
  }
  return place.likelihood;
}

void SubmapRegistrar::search_nearby(size_t variant) {
  const std::vector<const View*> newest = views(variant, options_.pose_keyframes);
  const std::vector<Alignment> candidates =
      alignments_for(variant, *newest.front(), lever_of({newest.front()}), 1.5 * index_->pitch());
  for (const PlaceCandidate& place : best_fine_places(newest, *index_, candidates, expected_, radius_,
                                                      options_.second_distance, 2, options_.evidence)) {
    places_.push_back({place.en, candidates[place.alignment], place.likelihood, variant, {}});
  }
}

void SubmapRegistrar::search_widely(size_t variant) {
  const double step = 2 * index_->pitch();
  const std::vector<const View*> submap = views(variant, options_.max_keyframes);
  const View& newest = *submap.front();
  const std::vector<Alignment> candidates = alignments_for(variant, newest, lever_of(submap), step);
  std::vector<CoarseLikelihood> around;
  around.reserve(keyframes_.size());
  std::vector<ShiftedLikelihood> all;
  for (Remembered& keyframe : keyframes_) {
    Variant& each = keyframe.variants[variant];
    const View& view = *each.view;
    const auto likelihood = [&](const SearchArea& area) {
      // A keyframe's own points lie close together: it needs fewer alignments than the submap.
      return coarse_likelihood(view, *index_, alignments_for(variant, view, lever_of({&view}), step), area,
                               options_.evidence);
    };
    if (std::isinf(radius_)) {
      // A picture made before the scale was known may have none for it.
      const auto has_scale = [&](const Alignment& alignment) {
        return std::abs(std::log(alignment.scale / candidates.front().scale)) <= 2 * KnownScale::kLeastStddev;
      };
      if (each.everywhere &&
          std::none_of(each.everywhere->alignments.begin(), each.everywhere->alignments.end(), has_scale)) {
        each.everywhere.reset();
      }
      if (!each.everywhere) each.everywhere = likelihood({});
      all.push_back({&*each.everywhere, view.keyframe.p_W_B, view.yaw});
    } else {
      const Eigen::Vector2d back =
          candidates.front().from_W(newest.yaw) * (view.keyframe.p_W_B - newest.keyframe.p_W_B).head<2>();
      around.push_back(likelihood({expected_ + back, radius_}));
      all.push_back({&around.back(), view.keyframe.p_W_B, view.yaw});
    }
  }
  compare_at_full_resolution(
      best_coarse_places(all, *index_, candidates, options_.second_distance, options_.coarse_places), candidates,
      variant);
}

void SubmapRegistrar::compare_at_full_resolution(const std::vector<PlaceCandidate>& coarse,
                                                 const std::vector<Alignment>& candidates, size_t variant) {
  for (const PlaceCandidate& candidate : coarse) {
    const Alignment& alignment = candidates[candidate.alignment];
    for (const PlaceCandidate& place :
         best_fine_places(views(variant, options_.max_keyframes), *index_, {alignment}, candidate.en,
                          3 * index_->pitch(), options_.second_distance, 1, options_.evidence)) {
      places_.push_back({place.en, alignment, place.likelihood, variant, {}});
    }
  }
}

}  // namespace orthonav::registration
