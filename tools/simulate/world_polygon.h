// Convex polygons, counter-clockwise, as the land is divided into.
#pragma once

#include <functional>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "tools/simulate/world_layout.h"

namespace orthonav::simulate {

struct Segment {
  Eigen::Vector2d a, b;
};

double area(const Outline& polygon);
Eigen::Vector2d centroid(const Outline& polygon);
bool contains(const Outline& polygon, const Eigen::Vector2d& p);
// The part where (p - point) . normal >= 0; empty when nothing is left.
Outline clip(const Outline& polygon, const Eigen::Vector2d& point, const Eigen::Vector2d& normal);
// The polygon shrunk by `distance` on every side; empty when nothing is left.
Outline inset(const Outline& polygon, double distance);
// The same, but the polygon itself when nothing would be left.
Outline inner(const Outline& polygon, double distance);
Outline rectangle(const Eigen::Vector2d& centre, double angle, double length, double width);
// The smallest rectangle around the polygon.
struct Box {
  Eigen::Vector2d centre;
  double angle, length, width;  // length >= width
};
Box bounding_box(const Outline& polygon);
// The cut of the polygon by the line through `point` along `direction`.
Segment chord(const Outline& polygon, const Eigen::Vector2d& point, const Eigen::Vector2d& direction);

// Divides until the pieces are about `target` m2, across their longer side. `jitter` (rad) turns the cuts, `spread`
// (0..0.5) moves them from the middle. `on_cut` hears of each cut and its depth. `random` draws from [0, 1).
std::vector<Outline> divide(const Outline& polygon, double target, double jitter, double spread,
                            const std::function<double()>& random,
                            const std::function<void(const Segment&, int depth)>& on_cut);

}  // namespace orthonav::simulate
