#include "services/registration/submap/view.h"

#include <algorithm>
#include <cmath>
#include <set>
#include <stdexcept>
#include <utility>

#include <fmt/format.h>
#include <opencv2/imgproc.hpp>

#include "common/math/so3.h"
#include "common/math/statistics.h"
#include "services/registration/submap/dot_products.h"

namespace orthonav::registration {
namespace {

// Of how far the ground is along a point's ray, by the height: points beyond lie on no ground that is in view; they
// were triangulated badly. One point at 10 km among a hundred would have registration search for turns of a kilometre's
// lever.
constexpr double kFurthest = 3;

// `factor`: by which the descriptor is shorter than those of the map.
template <int size>
Background background_of(const uint8_t* descriptor, double factor, const MapIndex::Spread<size>& spread) {
  const Eigen::Matrix<float, size, 1> values =
      Eigen::Map<const Eigen::Matrix<uint8_t, size, 1>>(descriptor).template cast<float>();
  const Eigen::Matrix<float, size, 1> difference = static_cast<float>(factor) * values - spread.mean_feature;
  Background background;
  background.product = values.dot(spread.mean_feature);
  background.mean = difference.dot(spread.mean);
  background.stddev = std::sqrt(std::max(1e-9F, quadratic_form(difference.data(), spread.covariance.data(), size)));
  return background;
}

// Leaves no more points than the ground that they cover has map features (`pitch` apart, m in W), but one to each that
// has any.
void keep_witnesses(std::vector<ViewPoint>& points, double pitch) {
  if (points.size() < 3) return;
  std::vector<cv::Point2f> ground, hull;
  for (const ViewPoint& point : points) {
    const Eigen::Vector2d cells = (point.p_W - points.front().p_W).head<2>() / pitch;
    ground.emplace_back(static_cast<float>(cells.x()), static_cast<float>(cells.y()));
  }
  cv::convexHull(ground, hull);
  const auto features = static_cast<size_t>(cv::contourArea(hull));
  if (features >= points.size()) return;
  std::set<std::pair<int, int>> taken;
  std::vector<char> first(points.size());  // of its feature
  for (size_t i = 0; i < points.size(); ++i) {
    first[i] = taken.emplace(cvFloor(ground[i].x), cvFloor(ground[i].y)).second;
  }
  size_t more = features - std::min(features, taken.size()), kept = 0;
  for (size_t i = 0; i < points.size(); ++i) {
    if (!first[i] && more == 0) continue;
    if (!first[i]) --more;
    if (kept != i) points[kept] = std::move(points[i]);
    ++kept;
  }
  points.resize(kept);
}

}  // namespace

double spread_of(const std::vector<const View*>& views) {
  std::vector<double> distances;
  for (const View* view : views) {
    for (const ViewPoint& point : view->points) {
      distances.push_back((point.p_W - views.front()->keyframe.p_W_B).head<2>().norm());
    }
  }
  if (distances.empty()) return 0;
  const double furthest = kFurthest * median(distances);
  double sum = 0, count = 0;
  for (const double distance : distances) {
    if (distance > furthest) continue;
    sum += distance * distance;
    ++count;
  }
  return std::sqrt(sum / std::max(1.0, count));
}

View make_view(const Keyframe& keyframe, const cv::Mat& image, const CameraModel& camera, double true_heading,
               double scale, const MapIndex& index, const MapGeometry& map, const QueryOptions& options) {
  View view;
  view.keyframe = keyframe;
  view.refused = reason_to_refuse(keyframe, image, camera, true_heading);
  if (!view.refused.empty()) return view;
  const Eigen::Matrix3d R_G_W = rotation_G_W(keyframe.q_W_B, true_heading);
  view.yaw = wrap_angle(heading_of(keyframe.q_W_B) - true_heading);
  const Eigen::Matrix3d R_G_C = R_G_W * keyframe.q_W_B.toRotationMatrix() * keyframe.extrinsics.R_B_C;
  const double height = keyframe.height_above_ground * scale;
  ImageSimilarity similarity;
  try {
    similarity = view_similarity(camera, R_G_C, height, map.metres_per_pixel, options.max_tilt);
  } catch (const std::invalid_argument& error) {
    view.refused = error.what();
    return view;
  }
  // Map pixels an image pixel is wide. Squares of finer ones than the map's are averaged; such as are too wide for a
  // descriptor are split.
  const double own_width = similarity.scale / camera.focal();
  const double widest = map.keypoint_size / 3;
  const double stretch = own_width < 1 ? 1 / std::round(1 / own_width) : std::max(1.0, std::ceil(own_width / widest));
  cv::Mat resized = image;
  if (stretch != 1) {
    const cv::Size size(static_cast<int>(image.cols * stretch), static_cast<int>(image.rows * stretch));
    const cv::Rect whole(0, 0, cvRound(size.width / stretch), cvRound(size.height / stretch));
    cv::resize(image(whole), resized, size, 0, 0, stretch < 1 ? cv::INTER_AREA : cv::INTER_LINEAR);
  }
  const double width = std::min(own_width / stretch, widest);
  view.field.emplace(resized, OrientationFieldOptions{map.keypoint_size, width, similarity.angle});

  // Ten map pixels east and south of a place, as the camera sees them.
  const double step = 10 * map.metres_per_pixel;
  const Eigen::Vector3d east = R_G_C.transpose() * Eigen::Vector3d(step, 0, 0);
  const Eigen::Vector3d south = R_G_C.transpose() * Eigen::Vector3d(0, -step, 0);
  view.points.reserve(keyframe.points.size());
  for (size_t i = 0; i < keyframe.points.size(); ++i) {
    const TrackedPoint& tracked = keyframe.points[i];
    if (!usable(tracked) || tracked.reprojection_error > options.max_reprojection_error) continue;
    if (!camera.contains(tracked.pixel)) continue;
    ViewPoint point;
    point.index = static_cast<int>(i);
    point.ray = tracked.ray_C.head<2>() / tracked.ray_C.z();
    point.p_W = tracked.p_W;
    const Eigen::Vector3d ray_G = R_G_C * point.ray.homogeneous();
    if (!(-ray_G.z() > 0.1 * ray_G.norm())) continue;
    const double to_ground = keyframe.height_above_ground * ray_G.norm() / -ray_G.z();
    if ((tracked.p_W - keyframe.p_W_B).norm() > kFurthest * to_ground) {
      ++view.num_contradicted;
      continue;
    }
    const Eigen::Vector3d p_C = height / -ray_G.z() * point.ray.homogeneous();
    const auto right = camera.project(p_C + east);
    const auto left = camera.project(p_C - east);
    const auto below = camera.project(p_C + south);
    const auto above = camera.project(p_C - south);
    if (!right || !left || !below || !above) continue;
    Eigen::Matrix2d jacobian;
    jacobian << (*right - *left) / 20, (*below - *above) / 20;
    point.jacobian = (stretch * jacobian).cast<float>();
    point.pixel = (stretch * (tracked.pixel.array() + 0.5) - 0.5).cast<float>();
    if (!view.field->describe(point.pixel, point.jacobian, point.descriptor.data())) continue;
    coarsen(point.descriptor.data(), kCoarseQueryLength, point.coarse.data());
    point.background = background_of(point.descriptor.data(), 1, index.spread());
    point.coarse_background =
        background_of(point.coarse.data(), kCoarseLength / kCoarseQueryLength, index.coarse_spread());
    view.points.push_back(point);
  }
  keep_witnesses(view.points, index.pitch() / scale);
  if (static_cast<int>(view.points.size()) <= options.min_points) {
    view.refused = fmt::format("{} usable points, more than {} are needed", view.points.size(), options.min_points);
    if (view.num_contradicted > 0) {
      view.refused += fmt::format("; {} lie more than {} times as far as the ground, by the height of {:.1f} m",
                                  view.num_contradicted, kFurthest, keyframe.height_above_ground);
    }
  }
  return view;
}

}  // namespace orthonav::registration
