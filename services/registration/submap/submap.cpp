// The part of SubmapRegistrar that remembers: the keyframes, and the headings that they are described under.
#include "services/registration/submap/submap.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <utility>

#include "common/math/so3.h"

namespace orthonav::registration {
namespace {

constexpr double kRadian = M_PI / 180;
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
  expectations_ = {};  // they were told in the other G
}

std::vector<const View*> SubmapRegistrar::views(size_t variant, int count) const {
  std::vector<const View*> result;
  for (const Remembered& keyframe : keyframes_) {
    if (static_cast<int>(result.size()) < count) result.push_back(keyframe.variants[variant].view.get());
  }
  return result;
}

// Whether the odometry has seen again what it saw in the keyframe before. Else it has come here blindly, if these are
// its own images still, and what was seen before lies elsewhere.
bool SubmapRegistrar::follow_points(const Keyframe& keyframe) {
  std::set<int64_t> ids;
  for (const TrackedPoint& point : keyframe.points) ids.insert(point.id);
  const auto is_known = [&](int64_t id) { return last_ids_.count(id) > 0; };
  // One that did not arrive between the two may link them.
  const bool is_next = keyframe.id == last_id_ + 1;
  const bool is_linked = !is_next || std::any_of(ids.begin(), ids.end(), is_known);
  last_id_ = keyframe.id;
  last_ids_ = std::move(ids);
  return is_linked;
}

void SubmapRegistrar::begin_anew() {
  keyframes_.clear();
  num_headings_ = 0;
  fitted_yaw_.reset();
  scale_.forget();
  ground_ = {};
  belief_.clear();
  p_W_.reset();
  num_fixes_ = 0;
}

bool SubmapRegistrar::describe(const Keyframe& keyframe, int session, const cv::Mat& image, const Heading& heading) {
  if (!has_map()) throw std::logic_error("no map to register to");
  const bool is_linked = follow_points(keyframe);
  if (session != session_ || !is_linked) begin_anew();
  session_ = session;
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
