// The part of SubmapRegistrar that looks for places: the keyframes that it remembers, the headings that they are
// described under, and the search.
#include "services/registration/submap.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "common/math/so3.h"

namespace orthonav::registration {
namespace {

constexpr double kRadian = M_PI / 180;
// How well a fix knows the heading for the next one.
constexpr double kFittedTurnStddev = 0.7 * kRadian;
// Between the headings that a place is looked for under where nothing is known of it: a descriptor stands half of it.
constexpr double kHeadingStep = 15 * kRadian;
// How far from the compass's another heading is looked for, in its standard deviations.
constexpr double kFurthestTurn = 4.5;

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
  submap.read("probability", options.probability, 0.5, 1);
  submap.read("temperature", options.temperature, 1, 1000);
  submap.read("min_inliers", options.min_inliers, 6, 10000);
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
  hint_.reset();  // it was told in the other G
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
    belief_.clear();
    p_W_.reset();
    num_fixes_ = 0;
  }
  places_.clear();
  num_contradicted_ = 0;
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
  num_contradicted_ = remembered.variants.front().view->num_contradicted;
  if (!refused_.empty()) return false;
  keyframes_.push_front(std::move(remembered));
  scale_.hear(keyframe.scale_stddev);
  carry_places(keyframe.p_W_B.head<2>());
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
  prior_ = prior;
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

bool SubmapRegistrar::is_heading_unknown() const {
  return !fitted_yaw_ && num_headings_ == 0;
}

bool SubmapRegistrar::is_expected(const Eigen::Vector2d& en) const {
  return (en - expected_).norm() <= expected_radius_ + index_->pitch() / std::sqrt(2.0);  // half a cell's diagonal
}

bool SubmapRegistrar::is_nearby() const {
  return radius_ <= kFineRadius;
}

}  // namespace orthonav::registration
