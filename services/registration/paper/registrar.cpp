#include "services/registration/paper/registrar.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

#include <fmt/format.h>

#include "common/math/statistics.h"
#include "services/registration/paper/pose.h"

namespace orthonav::registration {
namespace {

constexpr double kRadian = M_PI / 180.0;

}  // namespace

RegistrarOptions RegistrarOptions::from_config(ConfigNode& node) {
  RegistrarOptions options;
  std::string method = name_of(options.method);
  node.read("method", method);
  bool known = false;
  for (const MethodName each : {MethodName::kSubmap, MethodName::kPaper, MethodName::kM1, MethodName::kM2}) {
    if (method != name_of(each)) continue;
    options.method = each;
    known = true;
  }
  if (!known) node.fail("method", "must be submap, paper, m1 or m2");

  options.query = QueryOptions::from_config(node);

  ConfigNode matcher = node.child_or_empty("matcher");
  matcher.read("trees", options.matcher.trees, 1, 64);
  matcher.read("checks", options.matcher.checks, 1, 1'000'000);
  matcher.read("seed", options.matcher.seed, 0, 1'000'000'000);
  matcher.finish();

  ConfigNode voting = node.child_or_empty("voting");
  voting.read("inlier_radius", options.voting.inlier_radius, 0.01, 1000);
  voting.read("second_distance", options.voting.second_distance, 0, 1e6);
  voting.read("min_inliers", options.min_inliers, 6, 10000);
  voting.finish();

  ConfigNode pose = node.child_or_empty("pose");
  double max_tilt_difference_deg = options.max_tilt_difference / kRadian;
  pose.read("max_tilt_difference_deg", max_tilt_difference_deg, 0, 90);
  options.max_tilt_difference = max_tilt_difference_deg * kRadian;
  pose.finish();

  ConfigNode errors = node.child_or_empty("errors");
  errors.read("map_stddev", options.errors.map_stddev, 0, 100);
  errors.read("ground_height_stddev", options.errors.ground_height_stddev, 0, 1000);
  errors.read("scale_stddev", options.errors.scale_stddev, 0, 1);
  errors.read("matches_per_observation", options.errors.matches_per_observation, 1, 1000);
  errors.finish();
  return options;
}

Registrar::Registrar(const RegistrarOptions& options, const CameraModel& camera) : options_(options), camera_(camera) {}

void Registrar::set_map(MapFeatures features, const MapGeometry& geometry) {
  clear_map();
  const bool wants_detected = options_.method == MethodName::kM2;
  const bool detected = geometry.keypoint_size <= 0;
  if (wants_detected != detected) {
    throw std::invalid_argument(fmt::format("method {} needs a map with features: {}", name_of(options_.method),
                                            wants_detected ? "sift" : "grid"));
  }
  if (static_cast<size_t>(features.descriptors.rows) != features.positions.size()) {
    throw std::invalid_argument("positions and descriptors of the map differ in number");
  }
  if (!(geometry.metres_per_pixel > 0)) throw std::invalid_argument("the map's pixels have no size");
  matcher_.emplace(features.descriptors, options_.matcher);
  positions_ = std::move(features.positions);
  geometry_ = geometry;
}

void Registrar::clear_map() {
  matcher_.reset();
  positions_.clear();
}

Query Registrar::describe(const Keyframe& keyframe, const cv::Mat& image, const Heading& heading) const {
  if (!has_map()) throw std::logic_error("no map to register to");
  return make_query(keyframe, image, camera_, heading.value, geometry_, options_.query);
}

std::vector<DescriptorMatch> Registrar::match(const Query& query) {
  if (!matcher_) throw std::logic_error("no map to register to");
  if (!query.refused.empty()) return {};
  return matcher_->match(query.descriptors);
}

const Eigen::Vector3f& Registrar::map_position(const DescriptorMatch& match) const {
  return positions_.at(static_cast<size_t>(match.map));
}

Eigen::Vector2d Registrar::vote_of(const Keyframe& keyframe, const Query& query, const DescriptorMatch& match) const {
  const Eigen::Vector2d l = map_position(match).head<2>().cast<double>();
  const QueryPoint& point = query.points.at(static_cast<size_t>(match.query));
  if (options_.method == MethodName::kPaper) {
    const Eigen::Vector3d p_G = query.R_G_W * keyframe.points.at(static_cast<size_t>(point.index)).p_W;  // (7)
    return l - p_G.head<2>();                                                                            // (8)
  }
  const Eigen::Vector2d from_centre = geometry_.metres_per_pixel * (point.pixel - query.similarity.origin);
  return l - Eigen::Vector2d(from_centre.x(), -from_centre.y());
}

std::vector<Eigen::Vector2d> Registrar::votes(const Keyframe& keyframe, const Query& query,
                                              const std::vector<DescriptorMatch>& matches) const {
  std::vector<Eigen::Vector2d> votes;
  votes.reserve(matches.size());
  for (const DescriptorMatch& match : matches) votes.push_back(vote_of(keyframe, query, match));
  return votes;
}

Eigen::Vector2d Registrar::body_from_vote(const Keyframe& keyframe, const Query& query) const {
  if (options_.method == MethodName::kPaper) return (query.R_G_W * keyframe.p_W_B).head<2>();
  const Eigen::Matrix3d R_G_B = query.R_G_W * keyframe.q_W_B.toRotationMatrix();
  const Eigen::Vector3d axis = R_G_B * keyframe.extrinsics.R_B_C.col(2);
  return (keyframe.height_above_ground / axis.z() * axis - R_G_B * keyframe.extrinsics.p_B_C).head<2>();
}

double Registrar::map_area() const {
  Eigen::Vector2f low = Eigen::Vector2f::Constant(std::numeric_limits<float>::max()), high = -low;
  for (const Eigen::Vector3f& position : positions_) {
    low = low.cwiseMin(position.head<2>());
    high = high.cwiseMax(position.head<2>());
  }
  return positions_.empty() ? 0 : static_cast<double>((high - low).prod());
}

Fix Registrar::solve(const Keyframe& keyframe, const Query& query, const std::vector<DescriptorMatch>& matches,
                     const std::vector<Eigen::Vector2d>& votes, const Heading& heading) const {
  if (!has_map()) throw std::logic_error("no map to register to");
  Fix fix;
  fix.num_query = static_cast<int>(query.points.size());
  fix.reason = query.refused;
  if (!fix.reason.empty()) return fix;

  const VotingResult result = vote(votes, options_.voting);
  fix.num_candidates = static_cast<int>(votes.size());
  fix.num_inliers = static_cast<int>(result.inliers.size());
  fix.num_second_inliers = result.num_second;
  fix.translation = result.translation;

  std::vector<DescriptorMatch> inliers;
  Eigen::Matrix2d scatter = Eigen::Matrix2d::Zero();
  for (const int i : result.inliers) {
    const DescriptorMatch& match = matches[static_cast<size_t>(i)];
    inliers.push_back(match);
    const Eigen::Vector2d residual = votes[static_cast<size_t>(i)] - result.translation;
    scatter += residual * residual.transpose() / std::max(1.0, static_cast<double>(result.inliers.size()) - 1.0);
    Pair pair;
    const QueryPoint& point = query.points[static_cast<size_t>(match.query)];
    if (point.index >= 0) {
      pair.feature_id = keyframe.points[static_cast<size_t>(point.index)].id;
      pair.pixel = keyframe.points[static_cast<size_t>(point.index)].pixel;
    } else {
      pair.pixel = camera_.project(point.ray.homogeneous()).value_or(Eigen::Vector2d::Zero());
    }
    pair.map_en = map_position(match).head<2>().cast<double>();
    pair.residual = residual.norm();
    fix.pairs.push_back(pair);
  }
  if (fix.num_inliers < options_.min_inliers) {
    fix.reason = fmt::format("{} inliers, {} are needed", fix.num_inliers, options_.min_inliers);
    return fix;
  }
  if (options_.method == MethodName::kPaper) {
    place_by_points(keyframe, query, inliers, heading, scatter, fix);
  } else {
    place_by_image(keyframe, query, inliers, heading, scatter, fix);
  }
  if (fix.reason.empty() && !(fix.p_G_B.allFinite() && fix.covariance.allFinite()))
    fix.reason = "position is not finite";
  fix.valid = fix.reason.empty();
  return fix;
}

void Registrar::place_by_points(const Keyframe& keyframe, const Query& query,
                                const std::vector<DescriptorMatch>& inliers, const Heading& heading,
                                const Eigen::Matrix2d& scatter, Fix& fix) const {
  // The method is of two dimensions and leaves z untouched (9). The position on Earth has three: the points are also
  // lifted to the height of the map's features, by the median over the inliers.
  std::vector<double> lifts;
  for (const DescriptorMatch& match : inliers) {
    const int index = query.points[static_cast<size_t>(match.query)].index;
    lifts.push_back(map_position(match).z() - keyframe.points[static_cast<size_t>(index)].p_W.z());
  }
  const Eigen::Vector3d shift(fix.translation.x(), fix.translation.y(), median(lifts));
  std::vector<Eigen::Vector2d> rays;
  std::vector<Eigen::Vector3d> points_G;
  Eigen::Vector3d centre = Eigen::Vector3d::Zero();
  for (const DescriptorMatch& match : inliers) {
    const QueryPoint& point = query.points[static_cast<size_t>(match.query)];
    rays.push_back(point.ray);
    points_G.emplace_back(query.R_G_W * keyframe.points[static_cast<size_t>(point.index)].p_W + shift);  // (9)
    centre += points_G.back() / static_cast<double>(inliers.size());
  }
  const Extrinsics& extrinsics = keyframe.extrinsics;
  const Eigen::Matrix3d R_G_B = query.R_G_W * keyframe.q_W_B.toRotationMatrix();
  CameraPose odometry;
  odometry.R_G_C = R_G_B * extrinsics.R_B_C;
  odometry.p_G_C = query.R_G_W * keyframe.p_W_B + shift + R_G_B * extrinsics.p_B_C;
  const auto pnp = solve_pnp(rays, points_G, camera_.focal(), odometry);
  if (!pnp) {
    fix.reason = "PnP found no pose";
    return;
  }
  const double difference = tilt_difference(pnp->pose.R_G_C, odometry.R_G_C);
  if (difference > options_.max_tilt_difference) {
    fix.reason = fmt::format("PnP's vertical is {:.1f} degrees from the odometry's", difference / kRadian);
    return;
  }
  const Eigen::Matrix3d R_G_B_pnp = pnp->pose.R_G_C * extrinsics.R_B_C.transpose();
  fix.q_G_B = Eigen::Quaterniond(R_G_B_pnp).normalized();
  fix.p_G_B = pnp->pose.p_G_C - R_G_B_pnp * extrinsics.p_B_C;  // (10)
  fix.covariance = covariance(fix.p_G_B - centre, heading, scatter, inliers.size()) + pnp->position_covariance;
}

void Registrar::place_by_image(const Keyframe& keyframe, const Query& query,
                               const std::vector<DescriptorMatch>& inliers, const Heading& heading,
                               const Eigen::Matrix2d& scatter, Fix& fix) const {
  std::vector<double> heights;
  heights.reserve(inliers.size());
  for (const DescriptorMatch& match : inliers) heights.push_back(map_position(match).z());
  const Eigen::Matrix3d R_G_B = query.R_G_W * keyframe.q_W_B.toRotationMatrix();
  const Eigen::Vector3d axis = R_G_B * keyframe.extrinsics.R_B_C.col(2);
  // The translation is where the image's centre lies: the camera stands back along its axis, at its height.
  const Eigen::Vector3d centre(fix.translation.x(), fix.translation.y(), median(heights));
  const Eigen::Vector3d p_G_C = centre + keyframe.height_above_ground / axis.z() * axis;
  fix.q_G_B = Eigen::Quaterniond(R_G_B).normalized();
  fix.p_G_B = p_G_C - R_G_B * keyframe.extrinsics.p_B_C;
  fix.covariance = covariance(fix.p_G_B - centre, heading, scatter, inliers.size());
}

Eigen::Matrix3d Registrar::covariance(const Eigen::Vector3d& lever, const Heading& heading,
                                      const Eigen::Matrix2d& scatter, size_t num_inliers) const {
  const ErrorModel& errors = options_.errors;
  const double observations = std::max(1.0, static_cast<double>(num_inliers) / errors.matches_per_observation);
  Eigen::Matrix3d covariance = Eigen::Matrix3d::Zero();
  covariance.topLeftCorner<2, 2>() =
      scatter / observations + errors.map_stddev * errors.map_stddev * Eigen::Matrix2d::Identity();
  covariance(2, 2) = errors.ground_height_stddev * errors.ground_height_stddev;
  // The body stands off the matched points by the lever, which a wrong heading turns and a wrong scale stretches.
  const Eigen::Vector3d turned(-lever.y(), lever.x(), 0);
  covariance += heading.stddev * heading.stddev * turned * turned.transpose();
  covariance += errors.scale_stddev * errors.scale_stddev * lever * lever.transpose();
  return covariance;
}

}  // namespace orthonav::registration
