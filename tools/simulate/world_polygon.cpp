#include "tools/simulate/world_polygon.h"

#include <cmath>
#include <numbers>

#include <opencv2/imgproc.hpp>

namespace orthonav::simulate {

namespace {

double cross(const Eigen::Vector2d& a, const Eigen::Vector2d& b) {
  return a.x() * b.y() - a.y() * b.x();
}

Eigen::Vector2d direction_of(double angle) {
  return {std::cos(angle), std::sin(angle)};
}

void divide_into(const Outline& polygon, double target, double jitter, double spread, int depth,
                 const std::function<double()>& random, const std::function<void(const Segment&, int)>& on_cut,
                 std::vector<Outline>& pieces) {
  if (polygon.size() < 3) return;
  if (area(polygon) < target * (0.75 + 1.25 * random())) {
    pieces.push_back(polygon);
    return;
  }
  const Box box = bounding_box(polygon);
  const Eigen::Vector2d along = direction_of(box.angle);
  const Eigen::Vector2d point = box.centre + along * box.length * spread * (2.0 * random() - 1.0);
  const double turn = jitter * (2.0 * random() - 1.0);
  const Eigen::Vector2d normal = direction_of(box.angle + turn);
  on_cut(chord(polygon, point, {-normal.y(), normal.x()}), depth);
  divide_into(clip(polygon, point, normal), target, jitter, spread, depth + 1, random, on_cut, pieces);
  divide_into(clip(polygon, point, -normal), target, jitter, spread, depth + 1, random, on_cut, pieces);
}

}  // namespace

double area(const Outline& polygon) {
  double twice = 0;
  for (size_t i = 0; i < polygon.size(); ++i) twice += cross(polygon[i], polygon[(i + 1) % polygon.size()]);
  return 0.5 * std::abs(twice);
}

Eigen::Vector2d centroid(const Outline& polygon) {
  Eigen::Vector2d sum = Eigen::Vector2d::Zero();
  double twice = 0;
  const Eigen::Vector2d& origin = polygon.front();
  for (size_t i = 0; i < polygon.size(); ++i) {
    const Eigen::Vector2d a = polygon[i] - origin, b = polygon[(i + 1) % polygon.size()] - origin;
    sum += cross(a, b) * (a + b) / 3.0;
    twice += cross(a, b);
  }
  return origin + sum / twice;
}

bool contains(const Outline& polygon, const Eigen::Vector2d& p) {
  for (size_t i = 0; i < polygon.size(); ++i) {
    const Eigen::Vector2d& a = polygon[i];
    if (cross(polygon[(i + 1) % polygon.size()] - a, p - a) < 0) return false;
  }
  return !polygon.empty();
}

Outline clip(const Outline& polygon, const Eigen::Vector2d& point, const Eigen::Vector2d& normal) {
  Outline kept;
  for (size_t i = 0; i < polygon.size(); ++i) {
    const Eigen::Vector2d &a = polygon[i], &b = polygon[(i + 1) % polygon.size()];
    const double da = (a - point).dot(normal), db = (b - point).dot(normal);
    if (da >= 0) kept.push_back(a);
    if ((da >= 0) != (db >= 0)) kept.push_back(a + (b - a) * (da / (da - db)));
  }
  return kept.size() < 3 ? Outline{} : kept;
}

Outline inset(const Outline& polygon, double distance) {
  Outline shrunk = polygon;
  for (size_t i = 0; i < polygon.size() && !shrunk.empty(); ++i) {
    const Eigen::Vector2d edge = polygon[(i + 1) % polygon.size()] - polygon[i];
    if (edge.norm() < 1e-6) continue;
    const Eigen::Vector2d normal = Eigen::Vector2d(-edge.y(), edge.x()).normalized();
    shrunk = clip(shrunk, polygon[i] + normal * distance, normal);
  }
  return shrunk;
}

Outline inner(const Outline& polygon, double distance) {
  const Outline shrunk = inset(polygon, distance);
  return shrunk.empty() ? polygon : shrunk;
}

Outline rectangle(const Eigen::Vector2d& centre, double angle, double length, double width) {
  const Eigen::Vector2d along = 0.5 * length * direction_of(angle);
  const Eigen::Vector2d across = 0.5 * width * direction_of(angle + std::numbers::pi / 2);
  return {centre - along - across, centre + along - across, centre + along + across, centre - along + across};
}

Box bounding_box(const Outline& polygon) {
  // Relative to the first vertex: OpenCV works in single precision.
  std::vector<cv::Point2f> points;
  for (const Eigen::Vector2d& p : polygon) {
    const Eigen::Vector2f q = (p - polygon.front()).cast<float>();
    points.emplace_back(q.x(), q.y());
  }
  const cv::RotatedRect r = cv::minAreaRect(points);
  Box box{polygon.front() + Eigen::Vector2d(r.center.x, r.center.y), r.angle * std::numbers::pi / 180.0, r.size.width,
          r.size.height};
  if (box.length < box.width) {
    std::swap(box.length, box.width);
    box.angle += std::numbers::pi / 2;
  }
  return box;
}

Segment chord(const Outline& polygon, const Eigen::Vector2d& point, const Eigen::Vector2d& direction) {
  double t_min = 1e12, t_max = -1e12;
  const Eigen::Vector2d normal(-direction.y(), direction.x());
  for (size_t i = 0; i < polygon.size(); ++i) {
    const Eigen::Vector2d &a = polygon[i], &b = polygon[(i + 1) % polygon.size()];
    const double da = (a - point).dot(normal), db = (b - point).dot(normal);
    if ((da >= 0) == (db >= 0)) continue;
    const double t = (a + (b - a) * (da / (da - db)) - point).dot(direction);
    t_min = std::min(t_min, t);
    t_max = std::max(t_max, t);
  }
  if (t_min > t_max) return {point, point};
  return {point + t_min * direction, point + t_max * direction};
}

std::vector<Outline> divide(const Outline& polygon, double target, double jitter, double spread,
                            const std::function<double()>& random,
                            const std::function<void(const Segment&, int)>& on_cut) {
  std::vector<Outline> pieces;
  divide_into(polygon, target, jitter, spread, 0, random, on_cut, pieces);
  return pieces;
}

}  // namespace orthonav::simulate
