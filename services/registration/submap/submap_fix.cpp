// The part of SubmapRegistrar that makes a fix of the places found: their fits, the heading, whether the best one is
// believed, and what is learnt from it.
#include <algorithm>
#include <cmath>

#include <fmt/format.h>

#include "common/math/so3.h"
#include "services/registration/submap/submap.h"

namespace orthonav::registration {
namespace {

constexpr double kRadian = M_PI / 180;
// What earlier fixes say of the heading, to the fit of the next one: so little that a wrong one is left behind, and
// instead of the compass, which would pull every fit towards its bias (5.7 degrees off, it left fits 3-4 degrees off).
// At half of this a fit went a quarter of the way back to where the compass had put the first.
constexpr double kLearntTurnStddev = 3 * kRadian;
constexpr double kFittedShare = 0.3;
// What the matches of a fix err by together in turn, rad, once others have taught.
constexpr double kTaughtStddev = 0.003;
// Of the newest points, the share that has to stay aligned for their fit to be believed without asking the rest of the
// submap: with less, fits over crops in rows and woods were rows and crowns off, up to 25 m.
constexpr double kSureShare = 0.2;

}  // namespace

// What few fixes taught may be wrong, and then nothing is found under it: a fix of 8 inliers blinded `testing_zone` 2
// for 220 s.
void SubmapRegistrar::miss() {
  constexpr int kDoubted = 8;  // keyframes
  scale_.missed();
  ++widened_;
  if (++without_fix_ < kDoubted || is_taught() || !fitted_yaw_) return;
  fitted_yaw_.reset();
  scale_.forget_fixes();
}

void SubmapRegistrar::learn_from(const PlaceFit& fit, const FittedPose& pose, size_t variant) {
  without_fix_ = 0;
  // Found elsewhere, it is looked for as far off until the expectation follows: nearer to a wrong one there are but
  // wrong places.
  const bool elsewhere = expected_radius_ > 0 && (pose.p_G_B.head<2>() - expected_).norm() > expected_radius_;
  if (!elsewhere) widened_ = 0;
  ++num_fixes_;
  fitted_yaw_ = fitted_yaw_ ? *fitted_yaw_ + kFittedShare * wrap_angle(pose.yaw - *fitted_yaw_) : pose.yaw;
  scale_.learn(fit);
  // The heading is known from now on: of each keyframe, what was described under another one is of no use.
  for (Remembered& keyframe : keyframes_) {
    if (keyframe.variants.size() == 1) continue;
    std::swap(keyframe.variants.front(), keyframe.variants[variant]);
    keyframe.variants.erase(keyframe.variants.begin() + 1, keyframe.variants.end());
    keyframe.variants.front().everywhere.reset();
  }
}

FitPrior SubmapRegistrar::fit_prior(size_t variant) const {
  const ScaleBelief scale = scale_.before_fit();
  FitPrior prior;
  prior.alignment.scale = std::exp(scale.log_scale);
  prior.scale_stddev = scale.stddev;
  // What was found under another heading than the compass's is not for the compass to draw back.
  const double back = wrap_angle(yaw() - keyframes_.front().variants[variant].view->yaw);
  const bool of_the_compass = !is_heading_unknown() && std::abs(back) <= kOfTheCompass * compass_stddev_;
  if (fitted_yaw_ || of_the_compass) prior.alignment.turn = back;
  prior.heading_stddev = fitted_yaw_            ? kLearntTurnStddev
                         : is_heading_unknown() ? M_PI
                         : of_the_compass       ? compass_stddev_
                                                : 0.5 * kTurnStep;
  if (scale_.is_fitted() && is_taught()) prior.common_stddev = kTaughtStddev;
  return prior;
}

PlaceFit SubmapRegistrar::fit_at(const Eigen::Vector2d& en, const Alignment& alignment, size_t variant) const {
  PlaceFit fit = fit_place(views(variant, options_.pose_keyframes), *index_, geometry_.metres_per_pixel, en, alignment,
                           fit_prior(variant), options_.fit);
  if (!fit.ok) fit.inliers = 0;
  return fit;
}

double SubmapRegistrar::submap_give() const {
  return 1.5 * index_->pitch();
}

double SubmapRegistrar::agree_with_submap(Candidate& candidate) const {
  const double give = submap_give();
  if (!candidate.fit.ok || aligned_share(candidate) >= kSureShare) return 0;
  // As far back as the scale lets its keyframes lie where they are taken to lie; that of all that is known of it, for
  // the newest alone are seen stretched.
  const ScaleBelief scale = scale_.after_fit(candidate.fit);
  std::vector<const View*> submap = views(candidate.place.variant, options_.max_keyframes);
  const auto is_far = [&](const View* view) {
    const Eigen::Vector3d way = view->keyframe.p_W_B - submap.front()->keyframe.p_W_B;
    return way.head<2>().norm() * std::max(KnownScale::kLeastStddev, scale.stddev) > give;
  };
  submap.erase(std::remove_if(submap.begin() + 1, submap.end(), is_far), submap.end());
  const Alignment alignment{candidate.fit.alignment.turn, std::exp(scale.log_scale)};
  const Eigen::Vector2d place =
      likeliest_place(submap, *index_, alignment, candidate.fit.en, options_.second_distance, options_.evidence);
  const double off = (place - candidate.fit.en).norm();
  if (off <= give) return 0;
  const PlaceFit again = fit_at(place, candidate.fit.alignment, candidate.place.variant);
  if (!again.ok || (again.en - place).norm() > give) return off;
  candidate.fit = again;
  return 0;
}

void SubmapRegistrar::find_heading(Candidate& candidate) {
  const size_t variant = candidate.place.variant;
  PlaceFit& fit = candidate.fit;
  if (!fit.ok) return;
  struct Look {
    double turn;
    std::vector<Variant> variants;
    Eigen::Vector2d en;
    double likelihood;
  };
  const auto look = [&](double turn) {
    Look result{turn, {}, fit.en, -std::numeric_limits<double>::infinity()};
    std::vector<const View*> newest;
    for (size_t k = 0; k < keyframes_.size() && k < static_cast<size_t>(options_.pose_keyframes); ++k) {
      result.variants.push_back(described(keyframes_[k].keyframe(), keyframes_[k].image, turn));
      newest.push_back(result.variants.back().view.get());
    }
    const auto places = best_fine_places(newest, *index_, {{0, fit.alignment.scale}}, fit.en, options_.second_distance,
                                         options_.second_distance, 1, options_.evidence);
    if (!places.empty()) {
      result.en = places.front().en;
      result.likelihood = places.front().likelihood;
    }
    return result;
  };
  // To the top, and between the three headings about it.
  Look best = look(wrap_angle(keyframes_.front().variants[variant].view->yaw + fit.alignment.turn - yaw()));
  double beside[2] = {0, 0};
  int lower = 0, side = 0;
  for (int k = 0; lower < 2 && k * kTurnStep < 2 * M_PI; ++k) {
    Look next = look(wrap_angle(best.turn + (side == 0 ? kTurnStep : -kTurnStep)));
    if (next.likelihood > best.likelihood) {
      beside[1 - side] = best.likelihood;
      best = std::move(next);
      lower = 1;
    } else {
      beside[side] = next.likelihood;
      side = 1 - side;
      ++lower;
    }
  }
  const double bend = 2 * best.likelihood - beside[0] - beside[1];
  if (bend > 0 && std::isfinite(bend)) {
    best = look(wrap_angle(best.turn + 0.5 * kTurnStep * (beside[0] - beside[1]) / bend));
  }
  for (size_t k = 0; k < best.variants.size(); ++k) keyframes_[k].variants[variant] = std::move(best.variants[k]);
  fit = fit_at(best.en, {0, fit.alignment.scale}, variant);
}

double SubmapRegistrar::own_evidence(const PlaceFit& fit, size_t variant) const {
  const std::vector<const View*> newest = views(variant, 1);
  const Eigen::Matrix2d G_W = fit.alignment.from_W(newest.front()->yaw);
  return SubmapEvidence(newest, G_W, *index_, options_.temperature, options_.evidence)
      .log_likelihood_ratio(fit.en, G_W);
}

double SubmapRegistrar::aligned_share(const Candidate& place) const {
  size_t points = 0;
  for (const View* view : views(place.place.variant, options_.pose_keyframes)) points += view->points.size();
  return place.fit.inliers / static_cast<double>(points);
}

Fix SubmapRegistrar::solve() {
  Fix fix;
  fix.reason = refused_;
  fix.num_keyframes = static_cast<int>(keyframes_.size());
  fix.num_contradicted = num_contradicted_;
  if (!fix.reason.empty()) return fix;
  fix.search_radius = radius_;
  for (const View* view : views(0, options_.max_keyframes)) fix.num_query += static_cast<int>(view->points.size());
  fix.num_hypotheses = static_cast<int>(belief_.hypotheses().size());
  if (belief_.hypotheses().empty()) {
    miss();
    fix.reason = "no place on the map looks like the submap";
    return fix;
  }
  const PlaceHypothesis hypothesis = belief_.hypotheses().front();
  Candidate best{found_or_carried(hypothesis), {}};
  best.fit = fit_at(best.place.en, best.place.alignment, best.place.variant);
  const double disagreement = agree_with_submap(best);
  fix.log_likelihood = best.place.likelihood;
  fix.log_likelihood_ratio = likelihood_ratio(best.place, best.fit.en);
  fix.log_odds = belief_.log_odds(hypothesis.id);
  const PlaceFit& fit = best.fit;
  fix.num_inliers = static_cast<int>(fit.inliers);
  scale_.saw(aligned_share(best));
  is_firm_ = aligned_share(best) >= kSureShare;
  if (belief_.probability(hypothesis.id) < options_.probability) {
    fix.reason = fmt::format("the place is not sure: {} possible, the likeliest of {:.1f} %, none of them of {:.1f} %",
                             fix.num_hypotheses, 100 * belief_.probability(hypothesis.id), 100 * belief_.none());
  } else if (fix.num_inliers < options_.min_inliers) {
    fix.reason = fmt::format("{} inliers, {} are needed", fix.num_inliers, options_.min_inliers);
  } else if (const PlaceHypothesis* fitted = belief_.agreeing(fit.en, submap_give());
             fitted == nullptr || fitted->id != hypothesis.id) {
    fix.reason =
        fmt::format("its matches lead {:.0f} m away from the place that is sure", (fit.en - hypothesis.en).norm());
  }
  if (fix.reason.empty() && disagreement > 0) {
    fix.reason =
        fmt::format("the whole submap looks like a place {:.0f} m from where its newest keyframes fit", disagreement);
  }
  if (fix.reason.empty() && !fitted_yaw_) {
    find_heading(best);
    fix.num_inliers = static_cast<int>(fit.inliers);
  }
  const View& newest = *views(best.place.variant, 1).front();
  if (fix.reason.empty() && fit.ok) {
    scale_.ask_the_way(views(best.place.variant, options_.max_keyframes), static_cast<size_t>(options_.pose_keyframes),
                       options_.keyframe_spacing * newest.keyframe.height_above_ground, fit, *index_, options_.evidence,
                       options_.fit);
  }
  const ScaleBelief scale = fit.ok ? scale_.after_fit(fit) : scale_.expected();
  // Fixes remember the ground; where there were none of late, the submap has to tell, of a place that is accepted.
  const bool remembered = ground_.known() && without_fix_ < options_.max_keyframes;
  GroundLevel ground =
      remembered || !fix.reason.empty()
          ? ground_
          : ground_along(views(best.place.variant, options_.max_keyframes), fit, scale, *index_, options_.fit);
  const FittedPose pose = fit.ok ? fit_pose(views(best.place.variant, options_.pose_keyframes), fit,
                                            fit_prior(best.place.variant), scale, options_.fit, ground)
                                 : FittedPose{};
  const double odometry_heading = heading_of(newest.keyframe.q_W_B);
  const double yaw = pose.ok            ? pose.yaw
                     : heading_.known() ? wrap_angle(odometry_heading - heading_.value)
                                        : this->yaw();
  const Eigen::Vector2d en = pose.ok ? pose.p_G_B.head<2>() : best.place.en;
  fix.translation = en - Eigen::Rotation2Dd(yaw) * newest.keyframe.p_W_B.head<2>();
  fix.num_candidates = fix.num_query;
  for (const PlacedPoint& placed : fit.points) {
    if (placed.view != 0 || placed.weight < 0.1) continue;
    const TrackedPoint& tracked =
        newest.keyframe.points[static_cast<size_t>(newest.points[static_cast<size_t>(placed.point)].index)];
    fix.pairs.push_back({tracked.id, tracked.pixel, placed.en, placed.residual.norm()});
  }
  if (pose.ok) {
    fix.p_G_B = pose.p_G_B;
    fix.q_G_B = pose.q_G_B;
    fix.covariance = pose.covariance;
    fix.upright = pose.upright;
    // The fewer stay, the more it is the submap that says where, to within its cells.
    const double of_the_submap = std::max(0.0, 1 - aligned_share(best) / kSureShare);
    const double give = of_the_submap * submap_give() * submap_give() / 3;
    fix.covariance.topLeftCorner<2, 2>() += give * Eigen::Matrix2d::Identity();
    fix.upright.covariance.topLeftCorner<2, 2>() += give * Eigen::Matrix2d::Identity();
    fix.scale = pose.scale;
    fix.scale_stddev = pose.scale_stddev;
    fix.heading_correction = wrap_angle(odometry_heading - yaw - heading_.value);
    fix.heading_correction_stddev = pose.yaw_stddev;
  }
  if (fix.reason.empty() && !pose.ok) fix.reason = "the matches give no pose";
  // Ground that older keyframes saw stays where the odometry has carried it, whatever has become of the odometry.
  if (fix.reason.empty() && own_evidence(fit, best.place.variant) < 0) {
    fix.reason = "what the newest keyframe alone sees does not look like the place";
  }
  const double fix_stddev = std::sqrt(0.5 * fix.covariance.topLeftCorner<2, 2>().trace());
  fix.valid = fix.reason.empty();
  if (!fix.valid) {
    miss();
    return fix;
  }
  belief_.correct(hypothesis.id, pose.p_G_B.head<2>(), fit.alignment.from_W(newest.yaw), fix_stddev);
  expectations_.forget_hint();
  ground_ = std::move(ground);
  learn_from(fit, pose, best.place.variant);
  return fix;
}

}  // namespace orthonav::registration
