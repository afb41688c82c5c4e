// The part of SubmapRegistrar that weighs the places found and puts them to what is believed of the place.
#include <algorithm>
#include <cmath>
#include <utility>

#include "common/math/so3.h"
#include "services/registration/submap/submap.h"

namespace orthonav::registration {
void SubmapRegistrar::carry_places(const Eigen::Vector2d& p_W) {
  const double turn = is_heading_unknown() ? 1 : turn_stddev(0);
  const double way_stddev = std::hypot(turn, scale_.searched_stddev(false, is_taught()));
  belief_.carry(p_W, way_stddev);
  if (p_W_) {
    const Alignment expected{0, std::exp(scale_.expected().log_scale)};
    expectations_.carry(expected.from_W(yaw()) * (p_W - *p_W_), way_stddev);
  }
  p_W_ = p_W;
}

Eigen::Matrix2d SubmapRegistrar::G_W(const Place& place) const {
  return place.alignment.from_W(keyframes_.front().variants[place.variant].view->yaw);
}

PlacePrior SubmapRegistrar::place_prior() const {
  const double cell = index_->pitch() * index_->pitch();
  double num_alignments = 0;
  for (size_t variant = 0; variant < keyframes_.front().variants.size(); ++variant) {
    const std::vector<const View*> submap = views(variant, options_.max_keyframes);
    num_alignments +=
        static_cast<double>(alignments_for(variant, *submap.front(), lever_of(submap), 2 * index_->pitch()).size());
  }
  PlacePrior prior(cell, cell * index_->num_features(), num_alignments);
  expectations_.add_to(prior, index_->pitch());
  return prior;
}

void SubmapRegistrar::weigh() {
  std::vector<Place> different;
  for (const Place& place : places_) {
    const auto same = [&](const Place& other) { return (other.en - place.en).norm() < options_.second_distance; };
    if (std::none_of(different.begin(), different.end(), same)) different.push_back(place);
  }
  // Who is known already is weighed by the same, or what was found last would have more to say.
  for (const PlaceHypothesis& known : belief_.hypotheses()) {
    const auto same = [&](const Place& other) { return belief_.agreeing(other.en, index_->pitch()) == &known; };
    if (std::none_of(different.begin(), different.end(), same)) different.push_back(place_of(known));
  }
  for (size_t variant = 0; variant < keyframes_.front().variants.size(); ++variant) {
    std::optional<SubmapEvidence> evidence;
    for (Place& place : different) {
      if (place.variant != variant || place.evidence) continue;
      if (!evidence) {
        evidence.emplace(views(variant, options_.max_keyframes), G_W(place), *index_, options_.temperature,
                         options_.evidence);
      }
      place.evidence = evidence->log_likelihood_ratio(place.en, G_W(place));
    }
  }
  places_ = std::move(different);
}

PlaceBelief SubmapRegistrar::supposed() const {
  const PlacePrior prior = place_prior();
  PlaceBelief belief = belief_;
  for (const Place& place : places_) {
    if (!place.evidence) continue;
    belief.suppose(place.en, G_W(place), index_->pitch(), prior.log_probability(place.en) + *place.evidence);
  }
  return belief;
}

bool SubmapRegistrar::is_clear() {
  if (places_.empty()) return false;
  if (confirmed() != nullptr) return true;
  weigh();
  PlaceBelief belief = supposed();
  belief.settle();
  return !belief.hypotheses().empty() && belief.probability(belief.hypotheses().front().id) >= options_.probability;
}

SubmapRegistrar::Place SubmapRegistrar::place_of(const PlaceHypothesis& hypothesis) const {
  const double yaw = std::atan2(hypothesis.G_W(1, 0), hypothesis.G_W(0, 0));
  const auto& variants = keyframes_.front().variants;
  size_t nearest = 0;
  const auto off = [&](size_t variant) { return std::abs(wrap_angle(yaw - variants[variant].view->yaw)); };
  for (size_t variant = 1; variant < variants.size(); ++variant) {
    if (off(variant) < off(nearest)) nearest = variant;
  }
  const double scale = hypothesis.G_W.col(0).norm();
  return {hypothesis.en, {wrap_angle(yaw - variants[nearest].view->yaw), scale}, 0, nearest, {}};
}

const PlaceHypothesis* SubmapRegistrar::confirmed() const {
  if (places_.empty() || belief_.hypotheses().empty() || without_fix_ > 0 || !is_firm_) return nullptr;
  const PlaceHypothesis& likeliest = belief_.hypotheses().front();
  const bool is_sure = belief_.probability(likeliest.id) >= options_.probability;
  return is_sure && belief_.agreeing(places_.front().en, index_->pitch()) == &likeliest ? &likeliest : nullptr;
}

SubmapRegistrar::Place SubmapRegistrar::found_or_carried(const PlaceHypothesis& hypothesis) const {
  for (const Place& place : places_) {
    const PlaceHypothesis* known = belief_.agreeing(place.en, index_->pitch());
    if (known != nullptr && known->id == hypothesis.id) return place;
  }
  return place_of(hypothesis);
}

void SubmapRegistrar::believe() {
  if (const PlaceHypothesis* sure = confirmed()) {
    belief_.correct(sure->id, places_.front().en, G_W(places_.front()), index_->pitch());
  } else {
    weigh();
    belief_ = supposed();
    belief_.settle();
  }
}

}  // namespace orthonav::registration
