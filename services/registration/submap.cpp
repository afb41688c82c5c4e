#include "services/registration/submap.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include <fmt/format.h>

#include "common/math/so3.h"

namespace orthonav::registration {
namespace {

constexpr double kRadian = M_PI / 180;
// Largest radius, m, that is searched at full resolution at once.
constexpr double kFineRadius = 32;
// How well a fix knows the heading for the next one.
constexpr double kFittedTurnStddev = 0.7 * kRadian;
// What earlier fixes say of the heading, to the fit of the next one: so little that a wrong one is left behind, and
// instead of the compass, which would pull every fit towards its bias (5.7 degrees off, it left fits 3-4 degrees off).
// At half of this a fit went a quarter of the way back to where the compass had put the first.
constexpr double kLearntTurnStddev = 3 * kRadian;
constexpr double kFittedShare = 0.3;
// Fixes that teach what is believed, and what the matches of one err by together in turn, rad, then.
constexpr int kTaught = 4;
constexpr double kTaughtStddev = 0.003;
// Between the headings that a place is looked for under where nothing is known of it: a descriptor stands half of it.
constexpr double kHeadingStep = 15 * kRadian;
// The same where another one than the compass's is looked for, and how far from it, in its standard deviations.
constexpr double kTurnStep = 9 * kRadian, kFurthestTurn = 4.5;
// What is described under another one than so near to it, in its standard deviations, is not the compass's word.
constexpr double kOfTheCompass = 2;
// Of the newest points, the share that has to stay aligned for their fit to be believed without asking the rest of the
// submap: with less, fits over crops in rows and woods were rows and crowns off, up to 25 m.
constexpr double kSureShare = 0.2;
// What the share of points that stay aligned with the map counts, beside the likelihood as a share of the highest,
// where places are put in order: the points are those of the newest keyframes, which may see a wood, the likelihood is
// the whole submap's. At 3, `rural` 5 `years` took the less likely of two places for 40 s.
constexpr double kInlierOrder = 1.2;
// Places to which matches are aligned, to compare how many stay.
constexpr size_t kPlacesFitted = 3;

// How far from the newest body (m) a turn counts, for alignments that are to miss nothing.
double lever_of(const std::vector<const View*>& views) {
  return 1.5 * spread_of(views);
}

}  // namespace

SubmapOptions SubmapOptions::from_config(ConfigNode& node) {
  SubmapOptions options;
  options.query = QueryOptions::from_config(node);
  ConfigNode submap = node.child_or_empty("submap");
  submap.read("max_keyframes", options.max_keyframes, 1, 100);
  submap.read("keyframe_spacing", options.keyframe_spacing, 0, 10);
  submap.read("pose_keyframes", options.pose_keyframes, 1, 100);
  submap.read("search_heading", options.search_heading);
  submap.read("bound_stddevs", options.bound_stddevs, 1, 100);
  submap.read("min_radius", options.min_radius, 1, 1e6);
  submap.read("widening", options.widening, 1, 10);
  submap.read("second_distance", options.second_distance, 1, 1e6);
  submap.read("min_likelihood_ratio", options.acceptance.min_likelihood_ratio, 0, 1e9);
  submap.read("min_likelihood_share", options.acceptance.min_likelihood_share, 0, 1);
  submap.read("min_evidence", options.acceptance.min_evidence, 0, 10);
  submap.read("min_inliers", options.acceptance.min_inliers, 6, 10000);
  submap.read("scale_stddev", options.scale_stddev, 1e-4, 1);
  submap.read("lean", options.fit.lean, 0, 100);
  double tilt_stddev_deg = options.fit.tilt_stddev / kRadian;
  submap.read("tilt_stddev_deg", tilt_stddev_deg, 1e-3, 10);
  options.fit.tilt_stddev = tilt_stddev_deg * kRadian;
  submap.read("map_stddev", options.fit.map_stddev, 0, 100);
  submap.read("ground_height_stddev", options.fit.ground_height_stddev, 1e-3, 1000);
  submap.read("matches_per_observation", options.fit.matches_per_observation, 1, 1000);
  submap.finish();
  return options;
}

SubmapRegistrar::SubmapRegistrar(const SubmapOptions& options, const CameraModel& camera)
    : options_(options), camera_(camera), scale_(options.scale_stddev, options.widening, options.max_keyframes) {}

void SubmapRegistrar::set_map(MapFeatures features, const MapGeometry& geometry) {
  if (!(geometry.keypoint_size > 0)) throw std::invalid_argument("method submap needs a map with features: rootsift");
  index_.reset();  // the map is large: never hold two
  index_ = std::make_unique<MapIndex>(std::move(features), geometry);
  const bool comparable =
      geometry.metres_per_pixel == geometry_.metres_per_pixel && geometry.keypoint_size == geometry_.keypoint_size;
  if (!comparable) keyframes_.clear();
  for (Remembered& keyframe : keyframes_) {
    for (Variant& variant : keyframe.variants) {
      variant.everywhere.reset();
      for (ViewPoint& point : variant.view->points) point.aligned.clear();
    }
  }
  geometry_ = geometry;
}

void SubmapRegistrar::clear_map() {
  index_.reset();
  keyframes_.clear();
  session_ = -1;
}

std::vector<const View*> SubmapRegistrar::views(size_t variant, int count) const {
  std::vector<const View*> result;
  for (const Remembered& keyframe : keyframes_) {
    if (static_cast<int>(result.size()) < count) result.push_back(keyframe.variants[variant].view.get());
  }
  return result;
}

bool SubmapRegistrar::describe(const Keyframe& keyframe, int session, const cv::Mat& image, const Heading& heading) {
  if (!has_map()) throw std::logic_error("no map to register to");
  if (session != session_) {
    session_ = session;
    keyframes_.clear();
    num_headings_ = 0;
    fitted_yaw_.reset();
    scale_.forget();
    ground_ = {};
    held_ = {};
    num_fixes_ = 0;
  }
  places_.clear();
  heading_ = heading;
  refused_ = reason_to_refuse(keyframe, image, camera_, heading.value);
  if (!refused_.empty()) return false;
  const double odometry_heading = heading_of(keyframe.q_W_B);
  if (heading.known() && !options_.search_heading) {
    // What was described under any heading is of no use beside what is described under the compass's.
    if (num_headings_ == 0 && !fitted_yaw_) keyframes_.clear();
    compass_stddev_ = heading.stddev;
    const double yaw = wrap_angle(odometry_heading - heading.value);
    ++num_headings_;
    compass_yaw_ = num_headings_ == 1 ? yaw : compass_yaw_ + wrap_angle(yaw - compass_yaw_) / num_headings_;
  }
  Remembered remembered{image, {}};
  remembered.variants.push_back(described(keyframe, image, 0));
  refused_ = remembered.variants.front().view->refused;
  if (!refused_.empty()) return false;
  keyframes_.push_front(std::move(remembered));
  scale_.hear(keyframe.scale_stddev);
  thin_out();
  return true;
}

std::vector<double> SubmapRegistrar::turns() const {
  std::vector<double> turns{0};
  if (fitted_yaw_) return turns;
  if (is_heading_unknown()) {
    while (static_cast<int>(turns.size()) < std::lround(2 * M_PI / kHeadingStep)) {
      turns.push_back(turns.back() + kHeadingStep);
    }
    return turns;
  }
  const double near =
      std::min(kOfTheCompass * compass_stddev_, 0.5 * kHeadingStep);  // described under the compass's heading
  const double far = std::min(M_PI, kFurthestTurn * compass_stddev_);
  for (double turn = near + 0.5 * kTurnStep; turn < far; turn += kTurnStep) {
    turns.push_back(turn);
    turns.push_back(-turn);
  }
  return turns;
}

SubmapRegistrar::Variant SubmapRegistrar::described(const Keyframe& keyframe, const cv::Mat& image, double turn) const {
  Variant variant;
  variant.view =
      std::make_unique<View>(make_view(keyframe, image, camera_, heading_of(keyframe.q_W_B) - yaw() - turn,
                                       std::exp(scale_.expected().log_scale), *index_, geometry_, options_.query));
  return variant;
}

void SubmapRegistrar::describe_turned(const std::vector<double>& turns) {
  for (Remembered& remembered : keyframes_) {
    for (size_t i = remembered.variants.size(); i < turns.size(); ++i) {
      remembered.variants.push_back(described(remembered.keyframe(), remembered.image, turns[i]));
    }
  }
  drop_old_fields();
}

void SubmapRegistrar::drop_old_fields() {
  for (size_t k = static_cast<size_t>(options_.pose_keyframes); k < keyframes_.size(); ++k) {
    for (Variant& variant : keyframes_[k].variants) variant.view->field.reset();
  }
}

void SubmapRegistrar::thin_out() {
  drop_old_fields();
  const auto leaving = static_cast<size_t>(options_.pose_keyframes);  // no pose is made of it any more
  if (keyframes_.size() > leaving + 1) {
    const Keyframe& keyframe = keyframes_[leaving].keyframe();
    const Keyframe& before = keyframes_[leaving + 1].keyframe();
    const double distance = (keyframe.p_W_B - before.p_W_B).head<2>().norm();
    if (distance < options_.keyframe_spacing * keyframe.height_above_ground) {
      keyframes_.erase(keyframes_.begin() + options_.pose_keyframes);
    }
  }
  if (static_cast<int>(keyframes_.size()) > options_.max_keyframes) keyframes_.pop_back();
}

Alignment SubmapRegistrar::expected(const View& view, size_t variant) const {
  return {wrap_angle(yaw() + turns()[variant] - view.yaw), std::exp(scale_.expected().log_scale)};
}

std::vector<Alignment> SubmapRegistrar::alignments_for(size_t variant, const View& view, double lever,
                                                       double step) const {
  const double turn_stddev = fitted_yaw_            ? kFittedTurnStddev
                             : is_heading_unknown() ? 0.25 * kHeadingStep
                             : variant > 0          ? 0.25 * kTurnStep
                                                    : compass_stddev_;
  return alignments(expected(view, variant), turn_stddev,
                    scale_.searched_stddev(std::isinf(radius_), num_fixes_ >= kTaught), lever, step);
}

void SubmapRegistrar::search(const std::optional<PositionPrior>& prior) {
  if (!refused_.empty()) return;
  const Eigen::Vector2d size = index_->pitch() * Eigen::Vector2d(index_->columns(), index_->rows());
  radius_ = std::numeric_limits<double>::infinity();
  expected_radius_ = 0;
  if (prior && prior->en.allFinite() && std::isfinite(prior->stddev)) {
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

bool SubmapRegistrar::is_clear() const {
  if (places_.empty()) return false;
  const Place& best = places_.front();
  const double ratio = likelihood_ratio(best, best.en);
  return ratio >= options_.acceptance.min_likelihood_ratio &&
         ratio >= options_.acceptance.min_likelihood_share * best.likelihood;
}

void SubmapRegistrar::search_nearby(size_t variant) {
  const std::vector<const View*> newest = views(variant, options_.pose_keyframes);
  const std::vector<Alignment> candidates =
      alignments_for(variant, *newest.front(), lever_of({newest.front()}), 1.5 * index_->pitch());
  for (const PlaceCandidate& place : best_fine_places(newest, *index_, candidates, expected_, radius_,
                                                      options_.second_distance, 2, options_.evidence)) {
    places_.push_back({place.en, candidates[place.alignment], place.likelihood, variant});
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
      places_.push_back({place.en, alignment, place.likelihood, variant});
    }
  }
}

// What few fixes taught may be wrong, and then nothing is found under it: a fix of 8 inliers blinded `testing_zone` 2
// for 220 s.
void SubmapRegistrar::miss() {
  constexpr int kDoubted = 8;  // keyframes
  scale_.missed();
  ++widened_;
  if (++without_fix_ < kDoubted || num_fixes_ >= kTaught || !fitted_yaw_) return;
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

// Nearby any place agrees with any other: it is no news that it held.
int SubmapRegistrar::hold(const Place& place) {
  if (is_nearby()) return 0;
  const View& newest = *keyframes_.front().variants[place.variant].view;
  held_.found(newest.keyframe.p_W_B.head<2>(), place.en, place.alignment.from_W(newest.yaw), options_.second_distance,
              options_.keyframe_spacing * newest.keyframe.height_above_ground);
  return held_.new_ground();
}

bool SubmapRegistrar::is_heading_unknown() const {
  return !fitted_yaw_ && num_headings_ == 0;
}

bool SubmapRegistrar::is_expected(const Eigen::Vector2d& en) const {
  return (en - expected_).norm() <= expected_radius_ + index_->pitch() / std::sqrt(2.0);  // half a cell's diagonal
}

bool SubmapRegistrar::is_nearby() const {
  return radius_ <= kFineRadius;
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
  if (scale_.is_fitted() && num_fixes_ >= kTaught) prior.common_stddev = kTaughtStddev;
  return prior;
}

PlaceFit SubmapRegistrar::fit_at(const Eigen::Vector2d& en, const Alignment& alignment, size_t variant) const {
  PlaceFit fit = fit_place(views(variant, options_.pose_keyframes), *index_, geometry_.metres_per_pixel, en, alignment,
                           fit_prior(variant), options_.fit);
  if (!fit.ok) fit.inliers = 0;
  return fit;
}

std::vector<SubmapRegistrar::Candidate> SubmapRegistrar::fit_best_places() const {
  std::vector<Candidate> candidates;
  const auto is_near = [&](const Eigen::Vector2d& a, const Eigen::Vector2d& b) {
    return (a - b).norm() < options_.second_distance;
  };
  const size_t most = is_nearby() ? 1 : kPlacesFitted;
  size_t fitted = 0;
  for (const Place& place : places_) {
    if (fitted == most) break;
    const auto known = [&](const Candidate& other) { return is_near(other.place.en, place.en); };
    if (std::any_of(candidates.begin(), candidates.end(), known)) continue;
    ++fitted;
    Candidate candidate{place, fit_at(place.en, place.alignment, place.variant)};
    // The fit of the flank of a better place ends there.
    const auto same = [&](const Candidate& other) { return is_near(other.fit.en, candidate.fit.en); };
    if (std::none_of(candidates.begin(), candidates.end(), same)) candidates.push_back(std::move(candidate));
  }
  const double most_likely = places_.front().likelihood;
  const auto order = [&](const Candidate& each) {
    return each.place.likelihood / most_likely + kInlierOrder * aligned_share(each);
  };
  std::stable_sort(candidates.begin(), candidates.end(),
                   [&](const Candidate& a, const Candidate& b) { return order(a) > order(b); });
  return candidates;
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

double SubmapRegistrar::aligned_share(const Candidate& place) const {
  size_t points = 0;
  for (const View* view : views(place.place.variant, options_.pose_keyframes)) points += view->points.size();
  return place.fit.inliers / static_cast<double>(points);
}

Fix SubmapRegistrar::solve() {
  Fix fix;
  fix.reason = refused_;
  fix.num_keyframes = static_cast<int>(keyframes_.size());
  if (!fix.reason.empty()) return fix;
  fix.search_radius = radius_;
  for (const View* view : views(0, options_.max_keyframes)) fix.num_query += static_cast<int>(view->points.size());
  if (places_.empty()) {
    held_.not_found();
    miss();
    fix.reason = "no place on the map looks like the submap";
    return fix;
  }
  std::vector<Candidate> candidates = fit_best_places();
  const double disagreement = agree_with_submap(candidates.front());
  const Candidate& best = candidates.front();
  fix.log_likelihood = best.place.likelihood;
  fix.log_likelihood_ratio = likelihood_ratio(best.place, best.fit.en);
  const PlaceFit& fit = best.fit;
  fix.num_inliers = static_cast<int>(fit.inliers);
  if (candidates.size() > 1) fix.num_second_inliers = static_cast<int>(candidates[1].fit.inliers);
  const Standing standing{
      .log_likelihood = fix.log_likelihood,
      .log_likelihood_ratio = fix.log_likelihood_ratio,
      .aligned_share = aligned_share(best),
      .inliers = fix.num_inliers,
      .held = hold(best.place),
      .num_keyframes = fix.num_keyframes,
      .is_expected = is_nearby() && is_expected(fit.en),
  };
  scale_.saw(standing.aligned_share);
  fix.evidence = evidence(standing);
  fix.reason = doubt(standing, options_.acceptance);
  if (fix.reason.empty() && is_nearby() && !standing.is_expected) {
    fix.reason = "it fits beyond where the aircraft is expected, and was looked for";
  }
  if (fix.reason.empty() && disagreement > 0) {
    fix.reason =
        fmt::format("the whole submap looks like a place {:.0f} m from where its newest keyframes fit", disagreement);
  }
  if (fix.reason.empty() && !fitted_yaw_) {
    find_heading(candidates.front());
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
  fix.valid = fix.reason.empty();
  if (!fix.valid) {
    miss();
    return fix;
  }
  ground_ = std::move(ground);
  learn_from(fit, pose, best.place.variant);
  return fix;
}

}  // namespace orthonav::registration
