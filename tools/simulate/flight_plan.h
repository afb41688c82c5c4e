// Plans a flight over a rectangle: the survey of a multirotor in lanes with turns, changes of speed and height, gusts;
// or phases that are flown as ordered (flight_phases.h).
//
// The path is laid along a polyline flown at bounded acceleration, and its samples, plus what the gusts do to it, are
// the control points of a spline. Length, duration and mean tilt of a survey are met exactly: the polyline is cut,
// the legs' speed and the wind are scaled until they are.
#pragma once

#include <cstdint>
#include <functional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "tools/simulate/trajectory.h"

namespace orthonav {
class ConfigNode;
}

namespace orthonav::simulate {

// A stretch of a flight by orders.
struct Phase {
  std::string name;
  double seconds = 60.0;     // s
  double speed = 2.6;        // m/s over the ground; 0: hover
  double height_m = 110.0;   // m above the mean ground; 0: on the ground, landing where it is lowest nearby
  double climb_speed = 3.0;  // m/s, up or down to that height
  double bank_deg = 15.0;    // degrees, of turns
  bool circle = false;       // turns all the time, instead of flying lanes
  double spin_deg = 0.0;     // degrees/s, of the nose, counter-clockwise; 0: it points along the course
};

struct FlightOptions {
  double duration_s = 448.2;         // s, of the survey, without take-off
  double length_m = 1180.0;          // m, of its path
  double height_m = 110.0;           // m above the mean ground
  double mean_tilt_deg = 5.63;       // degrees from the vertical, mean over the flight
  double border_margin_m = 75.0;     // m, of the lanes to the border of the map
  bool take_off = false;             // from the ground, after a standstill, instead of starting in the air
  double standstill_s = 6.0;         // s on the ground before take-off
  double climb_speed = 3.0;          // m/s, of the take-off
  double leg_speed_spread = 0.3;     // the legs' speeds are the mean one times 1 +- this
  double turn_speed = 1.0;           // m/s, at corners of 90 degrees
  double acceleration = 0.8;         // m/s^2, along the path
  double waypoint_jitter_m = 8.0;    // m, by which waypoints are off the lanes, at most
  double wander_stddev_m = 0.35;     // m per axis, 1 sigma: how well the autopilot holds the path in gusts
  double wander_time_s = 4.0;        // s, correlation time of that
  double height_stddev_m = 1.5;      // m, 1 sigma, of slow changes of height
  double height_time_s = 25.0;       // s, correlation time of that
  double drag = 0.15;                // 1/s: acceleration of the airframe per airspeed
  double gust_ratio = 0.35;          // standard deviation of the wind per axis over its mean
  double gust_time_s = 3.0;          // s, correlation time of gusts
  double follow_course = 0.6;        // fraction of lanes on which the nose points along the course
  double yaw_rate_deg = 20.0;        // degrees/s, fastest turn of the nose
  double yaw_wander_deg = 1.5;       // degrees, 1 sigma, of the heading hold
  double attitude_jitter_deg = 0.2;  // degrees per axis, 1 sigma, of the attitude control around 1 Hz
  double wind_speed = 5.0;           // m/s, mean, of a flight by phases
  std::vector<Phase> phases;         // flown instead of the survey; empty: the survey

  static FlightOptions from_config(ConfigNode& node);
};

// Where to fly, m in G.
struct FlightArea {
  double east_min = 0, east_max = 0, north_min = 0, north_max = 0;
  double ground_height = 0;                                    // mean
  std::function<double(const Eigen::Vector2d& p_en)> surface;  // height at a point, for take-off
};

// The lowest surface within 15 m of a place: aircraft neither start from roofs and treetops nor land on them.
Eigen::Vector2d landing_place(const FlightArea& area, const Eigen::Vector2d& near);

// Throws std::invalid_argument when the area is too small for the margin or for a phase's turns, or when the options
// cannot be met (an acceleration that already tilts the aircraft further than the mean tilt asked for).
Trajectory plan_flight(const FlightOptions& options, const FlightArea& area, double gravity, uint64_t seed);

}  // namespace orthonav::simulate
