// Flights by orders: phases flown one after another, each with its speed, height, turns and spin.
//
// A point with bounded acceleration and bank is steered round a circuit of lanes over the map, or in circles. What
// comes out is the motion before gusts; plan_flight makes a spline of it, which rounds the corners of an order over a
// second.
#pragma once

#include <cstdint>

#include <Eigen/Core>

#include "tools/simulate/flight_plan.h"
#include "tools/simulate/sampled_motion.h"

namespace orthonav::simulate {

inline constexpr double kSettle = 2.0;  // s between a take-off's climb and what follows

struct OrderedFlight {
  // East, north, up (m in G) and heading of the nose (rad, counter-clockwise from east, without jumps).
  SampledMotion<Eigen::Vector4d> motion;
  double duration = 0;  // s
};

// Flies options.phases, after a take-off where `options` asks for one. `ground_offset`, m, is the height of a standing
// aircraft's body over the ground. Throws std::invalid_argument when a phase's turns do not fit over the map.
OrderedFlight fly_phases(const FlightOptions& options, const FlightArea& area, double gravity, double ground_offset,
                         uint64_t seed);

}  // namespace orthonav::simulate
