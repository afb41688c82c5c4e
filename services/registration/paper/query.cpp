#include "services/registration/paper/query.h"

#include <stdexcept>

#include <fmt/format.h>

#include "common/features/fixed_sift.h"
#include "common/features/warp.h"

namespace orthonav::registration {
namespace {

cv::Mat turned_image(const cv::Mat& image, const CameraModel& camera, const ImageSimilarity& similarity) {
  const WarpGrid grid{similarity.size, 16};
  const cv::Mat nodes = sample_nodes(grid, [&](const Eigen::Vector2d& pixel) -> Eigen::Vector2d {
    const Eigen::Vector2d xy = similarity.invert(pixel);
    // Rays outside the lens model's range fall beyond the border, whose edge is repeated.
    return camera.project(xy.homogeneous()).value_or(Eigen::Vector2d(-1e4, -1e4));
  });
  return warp_grey(image, mapping_of(grid, nodes, {}), camera.focal() / similarity.scale);
}

// Points of the detector that lie within the camera's image.
void detect_points(const cv::Mat& turned, const CameraModel& camera, Query& query) {
  const DetectedSift detected = detect_sift(turned);
  for (size_t i = 0; i < detected.points.size(); ++i) {
    const Eigen::Vector2d pixel(detected.points[i].x, detected.points[i].y);
    const Eigen::Vector2d ray = query.similarity.invert(pixel);
    const auto raw = camera.project(ray.homogeneous());
    if (!raw || !camera.contains(*raw)) continue;
    query.points.push_back({-1, ray, pixel});
    query.descriptors.push_back(detected.descriptors.row(static_cast<int>(i)));
  }
}

void describe_points(const Keyframe& keyframe, const cv::Mat& turned, const MapGeometry& map,
                     const QueryOptions& options, Query& query) {
  std::vector<cv::Point2f> pixels;
  for (size_t i = 0; i < keyframe.points.size(); ++i) {
    const TrackedPoint& point = keyframe.points[i];
    if (!usable(point) || point.reprojection_error > options.max_reprojection_error) continue;
    const Eigen::Vector2d ray = point.ray_C.head<2>() / point.ray_C.z();
    const Eigen::Vector2d pixel = query.similarity.apply(ray);
    if (!(pixel.x() >= 0 && pixel.y() >= 0 && pixel.x() < turned.cols && pixel.y() < turned.rows)) continue;
    query.points.push_back({static_cast<int>(i), ray, pixel});
    pixels.emplace_back(static_cast<float>(pixel.x()), static_cast<float>(pixel.y()));
  }
  if (static_cast<int>(pixels.size()) <= options.min_points) return;
  query.descriptors = FixedSift(map.keypoint_size).describe(turned, pixels);
}

// A patch without gradient matches any other such patch: it says nothing of the place.
void drop_featureless(Query& query) {
  std::vector<QueryPoint> points;
  cv::Mat descriptors;
  for (int i = 0; i < query.descriptors.rows; ++i) {
    if (cv::countNonZero(query.descriptors.row(i)) == 0) continue;
    points.push_back(query.points[static_cast<size_t>(i)]);
    descriptors.push_back(query.descriptors.row(i));
  }
  query.points = std::move(points);
  query.descriptors = descriptors;
}

}  // namespace

Query make_query(const Keyframe& keyframe, const cv::Mat& image, const CameraModel& camera, double true_heading,
                 const MapGeometry& map, const QueryOptions& options) {
  Query query;
  query.refused = reason_to_refuse(keyframe, image, camera, true_heading);
  if (!query.refused.empty()) return query;
  query.R_G_W = rotation_G_W(keyframe.q_W_B, true_heading);
  const Eigen::Matrix3d R_G_C = query.R_G_W * keyframe.q_W_B.toRotationMatrix() * keyframe.extrinsics.R_B_C;
  try {
    query.similarity =
        view_similarity(camera, R_G_C, keyframe.height_above_ground, map.metres_per_pixel, options.max_tilt);
  } catch (const std::invalid_argument& error) {
    query.refused = error.what();
    return query;
  }
  const cv::Mat turned = turned_image(image, camera, query.similarity);
  if (map.keypoint_size > 0) {
    describe_points(keyframe, turned, map, options, query);
  } else {
    detect_points(turned, camera, query);
  }
  if (!query.descriptors.empty()) drop_featureless(query);
  if (static_cast<int>(query.points.size()) <= options.min_points) {
    query.refused = fmt::format("{} usable points, more than {} are needed", query.points.size(), options.min_points);
  }
  return query;
}

}  // namespace orthonav::registration
