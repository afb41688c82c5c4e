#include "tools/simulate/flight_plan.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <stdexcept>
#include <string>
#include <vector>

#include "common/config/config.h"
#include "common/math/angles.h"
#include "common/math/so3.h"
#include "tools/simulate/flight_phases.h"
#include "tools/simulate/lanes.h"
#include "tools/simulate/random_stream.h"
#include "tools/simulate/sampled_motion.h"

namespace orthonav::simulate {
namespace {

constexpr double kPathStep = 0.75;          // s between control points of the position
constexpr double kYawStep = 1.0;            // s
constexpr double kWindStep = 0.5;           // s
constexpr double kJitterStep = 0.12;        // s
constexpr double kWaypointSpacing = 120.0;  // m, longest stretch of a lane without a waypoint
constexpr double kSample = SampledMotion<double>::kStep;
constexpr double kBodyAboveGround = 0.15;  // m, of an aircraft on its legs
constexpr double kFullGusts = 5.0;         // m above the ground, from where a flight by phases has them
// Standard deviation of a degree 7 spline whose control points are independent with unit variance.
constexpr double kWhiteSplineStddev = 0.5875;

struct Leg {
  Eigen::Vector2d from, to;
  double start = 0;       // m along the path
  double length = 0;      // m
  double speed = 1;       // times the mean speed
  double exit_speed = 0;  // m/s, at its end, at most
  double yaw = 0;         // rad, wanted heading of the nose, counter-clockwise from east

  Eigen::Vector2d direction() const { return (to - from) / length; }
};

Eigen::Vector2d clamp_to(const Eigen::Vector2d& p, const Eigen::Vector2d& low, const Eigen::Vector2d& high) {
  return p.cwiseMax(low).cwiseMin(high);
}

// Lanes over the rectangle, long enough for a path of `length`, in the order they are flown.
std::vector<Leg> lay_lanes(const FlightOptions& options, const FlightArea& area, double length, uint64_t seed) {
  RandomStream stream(seed, "flight.lanes");
  Lanes lanes(area, options.border_margin_m);
  if ((lanes.high - lanes.low).minCoeff() < 20.0) {
    throw std::invalid_argument("flight: border_margin_m leaves no room over the map");
  }
  // On a square, along either side.
  const double longer = lanes.length(lanes.along);
  if (longer - lanes.length(lanes.across()) < 0.15 * longer) lanes.along = stream.uniform(0, 1) < 0.5 ? 0 : 1;
  lanes.count = std::max(2, static_cast<int>(std::ceil(lanes.filled_by(options.length_m))));
  lanes.draw_start(stream);

  // Corners of the lanes, there and, for what length is left, back again.
  std::vector<Eigen::Vector2d> corners;
  for (int lane = 0; lane < lanes.count; ++lane) {
    corners.push_back(lanes.end(lane, lane % 2 == 1));
    corners.push_back(lanes.end(lane, lane % 2 == 0));
  }
  const std::vector<Eigen::Vector2d> there = corners;
  for (auto corner = there.rbegin() + 1; corner != there.rend(); ++corner) corners.push_back(*corner);

  std::vector<Leg> legs;
  double yaw = stream.uniform(-std::numbers::pi, std::numbers::pi);
  double total = 0;
  Eigen::Vector2d here = corners.front();
  for (size_t i = 0; total < 1.5 * length + 100.0; ++i) {
    // Once there and back, the flight goes round again.
    const Eigen::Vector2d begin = corners[i % (corners.size() - 1)];
    const Eigen::Vector2d end = corners[i % (corners.size() - 1) + 1];
    const int pieces = std::max(1, static_cast<int>(std::ceil((end - begin).norm() / kWaypointSpacing)));
    const Eigen::Vector2d course = (end - begin).normalized();
    if (stream.uniform(0, 1) < options.follow_course) {
      yaw = std::atan2(course.y(), course.x()) + stream.uniform(-10.0, 10.0) * kDegree;
    }
    for (int piece = 1; piece <= pieces; ++piece) {
      const Eigen::Vector2d jitter(stream.uniform(-1, 1), stream.uniform(-1, 1));
      Leg leg;
      leg.from = here;
      leg.to =
          clamp_to(begin + (end - begin) * piece / pieces + options.waypoint_jitter_m * jitter, lanes.low, lanes.high);
      leg.length = (leg.to - leg.from).norm();
      leg.speed = 1.0 + options.leg_speed_spread * stream.uniform(-1, 1);
      leg.yaw = yaw;
      if (leg.length < 1.0) continue;
      leg.start = total;
      total += leg.length;
      here = leg.to;
      legs.push_back(leg);
    }
  }
  for (size_t i = 0; i + 1 < legs.size(); ++i) {
    const double turn = std::acos(std::clamp(legs[i].direction().dot(legs[i + 1].direction()), -1.0, 1.0));
    // Slower the sharper the corner; the gentle ones are flown through.
    legs[i].exit_speed = options.turn_speed / std::max(1e-3, std::sin(0.5 * turn) / std::sin(45 * kDegree));
  }
  return legs;
}

size_t leg_at(const std::vector<Leg>& legs, double s) {
  size_t i = 0;
  while (i + 1 < legs.size() && s >= legs[i + 1].start) ++i;
  return i;
}

Eigen::Vector2d point_at(const std::vector<Leg>& legs, double s) {
  const Leg& leg = legs[leg_at(legs, s)];
  return leg.from + leg.direction() * (s - leg.start);
}

// Distance flown along the legs at times k * kSample.
std::vector<double> fly_legs(const FlightOptions& options, const std::vector<Leg>& legs, double speed, double seconds) {
  std::vector<double> distance;
  double s = 0;
  double v = options.take_off ? 0 : speed * legs.front().speed;
  const auto samples = static_cast<size_t>(seconds / kSample) + 1;
  distance.reserve(samples);
  size_t i = 0;
  while (distance.size() < samples) {
    distance.push_back(s);
    while (i + 1 < legs.size() && s >= legs[i + 1].start) ++i;
    double allowed = speed * legs[i].speed;
    for (size_t j = i; j < std::min(i + 3, legs.size()); ++j) {
      const double to_corner = std::max(0.0, legs[j].start + legs[j].length - s);
      const double exit = std::min(legs[j].exit_speed, speed * legs[j].speed);
      allowed = std::min(allowed, std::sqrt(exit * exit + 2 * options.acceleration * to_corner));
    }
    v += std::clamp(allowed - v, -options.acceleration * kSample, options.acceleration * kSample);
    v = std::max(v, 0.05);
    s += v * kSample;
  }
  return distance;
}

// Distance flown as a function of time, with the legs' speed such that `length` is flown in the duration.
SampledMotion<double> nominal_motion(const FlightOptions& options, const std::vector<Leg>& legs, double length) {
  const double seconds = options.duration_s + 10.0;
  double low = 0.05, high = 60.0;
  std::vector<double> distance;
  for (int i = 0; i < 40; ++i) {
    const double speed = 0.5 * (low + high);
    distance = fly_legs(options, legs, speed, seconds);
    const double flown = distance[static_cast<size_t>(options.duration_s / kSample)];
    (flown < length ? low : high) = speed;
  }
  if (high - low > 1e-3 || low > 59.0) {
    throw std::invalid_argument("flight: length_m cannot be flown in duration_s with these speeds in turns");
  }
  return SampledMotion<double>(std::move(distance));
}

// Everything that does not depend on the calibration, drawn once.
struct Planner {
  const FlightOptions& options;
  const FlightArea& area;
  double gravity;
  uint64_t seed;
  double end;                              // s
  std::function<double(double)> airborne;  // of a time: 0 on the ground, 1 in the air

  template <int Dim, class Value>
  UniformSpline<Dim> spline(double step, Value&& value) const {
    const size_t count = UniformSpline<Dim>::control_count(0, end, step);
    const double start = UniformSpline<Dim>::control_start(0, step);
    std::vector<typename UniformSpline<Dim>::Point> control(count);
    for (size_t i = 0; i < count; ++i) control[i] = value(start + static_cast<double>(i) * step, i);
    return UniformSpline<Dim>(start, step, std::move(control));
  }

  std::vector<double> noise(const char* name, double step, double stddev, double time) const {
    RandomStream stream(seed, name);
    return correlated_noise(stream, UniformSpline<1>::control_count(0, end, step), step, stddev, time);
  }

  // Of the nominal position, m in G, over time.
  template <class Nominal>
  UniformSpline<3> position(Nominal&& nominal) const {
    const auto east = noise("flight.wander.east", kPathStep, options.wander_stddev_m, options.wander_time_s);
    const auto north = noise("flight.wander.north", kPathStep, options.wander_stddev_m, options.wander_time_s);
    // Height is held better than position.
    const auto up = noise("flight.wander.up", kPathStep, 0.5 * options.wander_stddev_m, options.wander_time_s);
    const auto slow = noise("flight.height", kPathStep, options.height_stddev_m, options.height_time_s);
    return spline<3>(kPathStep, [&](double t, size_t i) {
      const double on = airborne(t);
      const Eigen::Vector3d p = nominal(t);
      return Eigen::Vector3d(p.x() + on * east[i], p.y() + on * north[i], p.z() + on * (up[i] + slow[i]));
    });
  }

  // Of the nominal heading, rad, asked for at rising times, kYawStep apart.
  template <class Nominal>
  UniformSpline<1> yaw(Nominal&& nominal) const {
    const auto wander = noise("flight.yaw", kYawStep, options.yaw_wander_deg * kDegree, 5.0);
    return spline<1>(kYawStep, [&](double t, size_t i) {
      return Eigen::Matrix<double, 1, 1>(nominal(t) + airborne(t) * wander[i]);
    });
  }

  UniformSpline<3> wind(double mean_speed) const {
    RandomStream stream(seed, "flight.wind");
    const double from = stream.uniform(-std::numbers::pi, std::numbers::pi);
    const Eigen::Vector3d mean(std::cos(from), std::sin(from), 0);
    const auto east = noise("flight.gust.east", kWindStep, options.gust_ratio, options.gust_time_s);
    const auto north = noise("flight.gust.north", kWindStep, options.gust_ratio, options.gust_time_s);
    const auto up = noise("flight.gust.up", kWindStep, 0.5 * options.gust_ratio, options.gust_time_s);
    return spline<3>(kWindStep, [&](double t, size_t i) {
      return Eigen::Vector3d(airborne(t) * mean_speed * (mean + Eigen::Vector3d(east[i], north[i], up[i])));
    });
  }

  UniformSpline<3> jitter() const {
    RandomStream stream(seed, "flight.jitter");
    const double stddev = options.attitude_jitter_deg * kDegree / kWhiteSplineStddev;
    return spline<3>(kJitterStep, [&](double t, size_t) {
      const Eigen::Vector3d white(stream.gaussian(), stream.gaussian(), stream.gaussian());
      return Eigen::Vector3d(airborne(t) * stddev * white);
    });
  }

  Trajectory assemble(const UniformSpline<3>& path, const UniformSpline<1>& nose, double wind_speed) const {
    return Trajectory({path, nose, wind(wind_speed), jitter(), options.drag, gravity, end});
  }
};

Trajectory plan_ordered_flight(const FlightOptions& options, const FlightArea& area, double gravity, uint64_t seed) {
  const OrderedFlight ordered = fly_phases(options, area, gravity, kBodyAboveGround, seed);
  const auto nominal = [&](double t) -> Eigen::Vector3d { return ordered.motion.at(t).head<3>(); };
  const auto airborne = [&](double t) {
    const Eigen::Vector3d p = nominal(t);
    return std::clamp((p.z() - kBodyAboveGround - area.surface(p.head<2>())) / kFullGusts, 0.0, 1.0);
  };
  const Planner planner{options, area, gravity, seed, ordered.duration, airborne};
  return planner.assemble(planner.position(nominal), planner.yaw([&](double t) { return ordered.motion.at(t).w(); }),
                          options.wind_speed);
}

Trajectory plan_survey(const FlightOptions& options, const FlightArea& area, double gravity, uint64_t seed) {
  std::vector<Leg> legs = lay_lanes(options, area, options.length_m, seed);
  Eigen::Vector2d start_en = legs.front().from;  // foot of the take-off
  const double survey_height = area.ground_height + options.height_m;
  double ground = 0, climb_begin = 0, survey_begin = 0;  // m in G, of the body; s
  if (options.take_off) {
    start_en = landing_place(area, legs.front().from);
    legs.front().from = start_en;
    legs.front().length = (legs.front().to - legs.front().from).norm();
    for (size_t i = 1; i < legs.size(); ++i) legs[i].start = legs[i - 1].start + legs[i - 1].length;
    ground = area.surface(start_en) + kBodyAboveGround;
    climb_begin = options.standstill_s;
    survey_begin = climb_begin + (survey_height - ground) / options.climb_speed + kSettle;
  }
  const auto airborne = [&](double t) {
    return options.take_off ? std::clamp((t - climb_begin - 0.5) / 2.0, 0.0, 1.0) : 1.0;
  };
  const Planner planner{options, area, gravity, seed, survey_begin + options.duration_s, airborne};

  // Gusts lengthen the path and corners shorten it: correct the nominal length until the flown one is right. The
  // part before the survey does not count.
  double nominal = options.length_m;
  SampledMotion<double> motion = nominal_motion(options, legs, nominal);
  const auto nominal_position = [&](double t) {
    const Eigen::Vector2d en =
        options.take_off && t < survey_begin ? start_en : point_at(legs, motion.at(t - survey_begin));
    double up = survey_height;
    if (options.take_off) up = std::min(up, ground + options.climb_speed * std::max(0.0, t - climb_begin));
    return Eigen::Vector3d(en.x(), en.y(), up);
  };
  UniformSpline<3> path = planner.position(nominal_position);
  const auto survey_length = [&](const UniformSpline<3>& p) {
    double length = 0;
    const auto steps = static_cast<int>(options.duration_s / 0.1);
    const double step = options.duration_s / steps;
    for (int i = 0; i < steps; ++i) length += step * p.evaluate(survey_begin + (i + 0.5) * step, 1).norm();
    return length;
  };
  for (int i = 0; i < 8; ++i) {
    const double flown = survey_length(path);
    if (std::abs(flown / options.length_m - 1) < 1e-4) break;
    nominal *= options.length_m / flown;
    motion = nominal_motion(options, legs, nominal);
    path = planner.position(nominal_position);
  }

  double heading = legs.front().yaw;
  const UniformSpline<1> nose = planner.yaw([&](double t) {
    const double most = options.yaw_rate_deg * kDegree * kYawStep;
    const double wanted = legs[leg_at(legs, motion.at(t - survey_begin))].yaw;
    return heading += std::clamp(wrap_angle(wanted - heading), -most, most);
  });
  const double wanted_tilt = options.mean_tilt_deg * kDegree;
  if (planner.assemble(path, nose, 0).mean_tilt() > wanted_tilt) {
    throw std::invalid_argument("flight: the manoeuvres alone tilt the aircraft more than mean_tilt_deg");
  }
  double low = 0, high = 60;  // m/s
  for (int i = 0; i < 14; ++i) {
    const double middle = 0.5 * (low + high);
    (planner.assemble(path, nose, middle).mean_tilt() < wanted_tilt ? low : high) = middle;
  }
  return planner.assemble(path, nose, 0.5 * (low + high));
}

// Each phase goes on as the one before it, but for what it says.
std::vector<Phase> read_phases(ConfigNode&& node, double height_m) {
  std::vector<std::string> names;
  node.read("names", names);
  std::vector<Phase> phases;
  Phase phase;
  phase.height_m = height_m;
  for (const std::string& name : names) {
    ConfigNode entry = node.child(name);
    phase.name = name;
    entry.read("seconds", phase.seconds, 0.1, 36000.0);
    entry.read("speed", phase.speed, 0.0, 60.0);
    entry.read("height_m", phase.height_m, 0.0, 5000.0);
    entry.read("climb_speed", phase.climb_speed, 0.1, 20.0);
    entry.read("bank_deg", phase.bank_deg, 1.0, 60.0);
    entry.read("circle", phase.circle);
    entry.read("spin_deg", phase.spin_deg, -180.0, 180.0);
    entry.finish();
    phases.push_back(phase);
  }
  node.finish();
  return phases;
}

}  // namespace

FlightOptions FlightOptions::from_config(ConfigNode& node) {
  FlightOptions o;
  node.read("duration_s", o.duration_s, 1.0, 36000.0);
  node.read("length_m", o.length_m, 10.0, 1e5);
  node.read("height_m", o.height_m, 5.0, 5000.0);
  node.read("mean_tilt_deg", o.mean_tilt_deg, 0.1, 30.0);
  node.read("border_margin_m", o.border_margin_m, 0.0, 1e4);
  node.read("take_off", o.take_off);
  node.read("standstill_s", o.standstill_s, 0.0, 600.0);
  node.read("climb_speed", o.climb_speed, 0.1, 20.0);
  node.read("leg_speed_spread", o.leg_speed_spread, 0.0, 0.9);
  node.read("turn_speed", o.turn_speed, 0.1, 50.0);
  node.read("acceleration", o.acceleration, 0.01, 20.0);
  node.read("waypoint_jitter_m", o.waypoint_jitter_m, 0.0, 1000.0);
  node.read("wander_stddev_m", o.wander_stddev_m, 0.0, 20.0);
  node.read("wander_time_s", o.wander_time_s, 0.1, 1000.0);
  node.read("height_stddev_m", o.height_stddev_m, 0.0, 100.0);
  node.read("height_time_s", o.height_time_s, 0.1, 10000.0);
  node.read("drag", o.drag, 0.001, 10.0);
  node.read("gust_ratio", o.gust_ratio, 0.0, 5.0);
  node.read("gust_time_s", o.gust_time_s, 0.1, 1000.0);
  node.read("follow_course", o.follow_course, 0.0, 1.0);
  node.read("yaw_rate_deg", o.yaw_rate_deg, 0.1, 180.0);
  node.read("yaw_wander_deg", o.yaw_wander_deg, 0.0, 90.0);
  node.read("attitude_jitter_deg", o.attitude_jitter_deg, 0.0, 20.0);
  node.read("wind_speed", o.wind_speed, 0.0, 30.0);
  o.phases = read_phases(node.child_or_empty("phases"), o.height_m);
  node.finish();
  return o;
}

Eigen::Vector2d landing_place(const FlightArea& area, const Eigen::Vector2d& near) {
  Eigen::Vector2d best = near;
  for (int north = -15; north <= 15; ++north) {
    for (int east = -15; east <= 15; ++east) {
      const Eigen::Vector2d candidate = near + Eigen::Vector2d(east, north);
      if (area.surface(candidate) < area.surface(best)) best = candidate;
    }
  }
  return best;
}

Trajectory plan_flight(const FlightOptions& options, const FlightArea& area, double gravity, uint64_t seed) {
  return options.phases.empty() ? plan_survey(options, area, gravity, seed)
                                : plan_ordered_flight(options, area, gravity, seed);
}

}  // namespace orthonav::simulate
