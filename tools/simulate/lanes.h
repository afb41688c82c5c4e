// Parallel lanes over an area less its border: where surveys and flights by orders turn.
#pragma once

#include <Eigen/Core>

#include "tools/simulate/flight_plan.h"
#include "tools/simulate/random_stream.h"

namespace orthonav::simulate {

struct Lanes {
  Eigen::Vector2d low, high;  // m in G
  int along = 0;              // axis of G that the lanes follow
  int count = 2;
  bool flip_along = false, flip_across = false;  // it begins at the far end, with the far lane

  // Lanes run along the longer side.
  Lanes(const FlightArea& area, double margin)
      : low(area.east_min + margin, area.north_min + margin), high(area.east_max - margin, area.north_max - margin) {
    along = length(0) > length(1) ? 0 : 1;
  }

  double length(int axis) const { return high[axis] - low[axis]; }
  int across() const { return 1 - along; }
  // Lanes that a way of `meters` fills.
  double filled_by(double meters) const { return (meters - length(across())) / length(along); }
  void draw_start(RandomStream& stream) {
    flip_along = stream.uniform(0, 1) < 0.5;
    flip_across = stream.uniform(0, 1) < 0.5;
  }
  // One end of a lane, the near or the far one.
  Eigen::Vector2d end(int lane, bool far) const {
    const double offset = lane * (length(across()) / (count - 1));
    Eigen::Vector2d p;
    p[along] = far != flip_along ? high[along] : low[along];
    p[across()] = flip_across ? high[across()] - offset : low[across()] + offset;
    return p;
  }
};

}  // namespace orthonav::simulate
