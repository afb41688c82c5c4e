#include "tools/simulate/flight_phases.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

#include <Eigen/Geometry>
#include <fmt/format.h>

#include "common/math/angles.h"
#include "common/math/so3.h"
#include "tools/simulate/lanes.h"
#include "tools/simulate/random_stream.h"

namespace orthonav::simulate {
namespace {

constexpr double kPastTheEnd = 10.0;      // s of motion beyond the flight, for the spline's last control points
constexpr double kSlowest = 1.0;          // m/s: slower aircraft turn as tightly as at this speed, and no tighter
constexpr double kCourseHold = 1.0;       // 1/s, rate of turn per error of the course
constexpr double kRollInAndOut = 1.25;    // times a circle's width is what a half-turn from lane to lane takes
constexpr double kToLandingPlace = 1.0;   // m/s
constexpr double kStraightUp = 5;         // m above the ground, below which it only rises or comes down
constexpr double kLeastLaneSpacing = 20;  // m
constexpr double kNever = -std::numeric_limits<double>::infinity();

double turn_radius(const Phase& phase, double speed, double gravity) {
  return speed * speed / (gravity * std::tan(phase.bank_deg * kDegree));
}

struct Waypoint {
  Eigen::Vector2d p;
  double speed = 1;  // of the leg that ends here, times the phase's
};

// Corners of lanes over the rectangle, an even number of lanes so that the last leads back to the first. Lanes are as
// far apart as a half-turn is wide, and no more than the flight fills.
std::vector<Waypoint> lay_circuit(const FlightOptions& options, const FlightArea& area, double gravity, uint64_t seed) {
  RandomStream stream(seed, "flight.circuit");
  Lanes lanes(area, options.border_margin_m);
  const double room = (lanes.high - lanes.low).minCoeff();
  double width = kLeastLaneSpacing, length = 0;
  for (const Phase& phase : options.phases) {
    const double fastest = phase.circle ? phase.speed : phase.speed * (1 + options.leg_speed_spread);
    width = std::max(width, (phase.circle ? 1.0 : kRollInAndOut) * 2 * turn_radius(phase, fastest, gravity));
    length += phase.seconds * phase.speed;
    if (width > room) {
      throw std::invalid_argument(fmt::format(
          "flight.phases.{}: a turn is {:.0f} m wide, and border_margin_m leaves {:.0f} m of the map: bank more, fly "
          "slower or enlarge the world",
          phase.name, width, room));
    }
  }
  const int fitting = static_cast<int>(lanes.length(lanes.across()) / width) + 1;
  const int wanted = static_cast<int>(std::ceil(lanes.filled_by(length)));
  lanes.count = std::max(2, 2 * (std::min(fitting, wanted) / 2));
  lanes.draw_start(stream);
  std::vector<Waypoint> circuit;
  for (int corner = 0; corner < 2 * lanes.count; ++corner) {
    Waypoint waypoint;
    waypoint.p = lanes.end(corner / 2, corner % 4 == 1 || corner % 4 == 2);
    waypoint.speed = 1.0 + options.leg_speed_spread * stream.uniform(-1, 1);
    circuit.push_back(waypoint);
  }
  return circuit;
}

// Steers the point. Members are the state.
class Pilot {
 public:
  Pilot(const FlightOptions& options, const FlightArea& area, double gravity, double ground_offset,
        std::vector<Waypoint> circuit)
      : options_(options),
        area_(area),
        gravity_(gravity),
        ground_offset_(ground_offset),
        circuit_(std::move(circuit)),
        centre_(0.5 * (area.east_min + area.east_max), 0.5 * (area.north_min + area.north_max)) {
    // In the middle of a lane a circle to either side fits over the map.
    p_ = 0.5 * (circuit_[0].p + circuit_[1].p);
    course_ = yaw_ = course_to(circuit_[1].p);
  }

  void start_on_ground() {
    p_ = landing_place(area_, p_);
    z_ = ground();
    course_ = yaw_ = course_to(circuit_[1].p);  // it rises without a turn
    standing_ = true;
  }
  void start_in_flight(const Phase& phase) {
    z_ = area_.ground_height + phase.height_m;
    speed_ = wanted_speed(phase);
  }
  double ground() const { return area_.surface(p_) + ground_offset_; }
  Eigen::Vector4d state() const { return {p_.x(), p_.y(), z_, yaw_}; }

  void begin(const Phase& phase) {
    const Eigen::Vector2d in = centre_ - p_;
    side_ = std::cos(course_) * in.y() - std::sin(course_) * in.x() > 0 ? 1.0 : -1.0;
    if (lands(phase)) {
      if (!standing_) landing_ = landing_place(area_, p_);
    } else if (standing_) {
      standing_ = false;
      clear_ = z_ + kStraightUp;
    }
  }

  void step(const Phase& phase, double dt) {
    if (standing_) return;
    const double climb = phase.climb_speed * dt;
    if (z_ < clear_ && !lands(phase)) {
      z_ += climb;
      return;
    }
    clear_ = kNever;
    speed_ += std::clamp(wanted_speed(phase) - speed_, -options_.acceleration * dt, options_.acceleration * dt);
    const double rate = rate_of_turn(phase);
    course_ += rate * dt;
    p_ += speed_ * dt * Eigen::Vector2d(std::cos(course_), std::sin(course_));
    double height = area_.ground_height + phase.height_m;
    if (lands(phase)) {
      const Eigen::Vector2d rest = landing_ - p_;
      p_ += rest * std::min(1.0, kToLandingPlace * dt / std::max(rest.norm(), 1e-9));
      const bool over_it = speed_ == 0 && p_.isApprox(landing_);
      height = ground() + (over_it ? 0.0 : kStraightUp);
      if (over_it && z_ < ground() + kStraightUp) {
        z_ = std::max(height, z_ - climb);
        standing_ = z_ == height;
        return;
      }
    }
    z_ += std::clamp(height - z_, -climb, climb);
    if (phase.spin_deg != 0) {
      yaw_ += phase.spin_deg * kDegree * dt;
    } else {
      const double turn = (std::abs(rate) + options_.yaw_rate_deg * kDegree) * dt;
      yaw_ += std::clamp(wrap_angle(course_ - yaw_), -turn, turn);
    }
  }

 private:
  static bool lands(const Phase& phase) { return phase.height_m <= 0; }
  double wanted_speed(const Phase& phase) const {
    if (lands(phase)) return 0;  // it comes down on a place
    return phase.speed * (phase.circle ? 1.0 : circuit_[next_].speed);
  }

  // rad/s. Of a circle, that of its radius at the speed which there is: an aircraft that hovers has no course to turn.
  double rate_of_turn(const Phase& phase) {
    const double most =
        gravity_ * std::tan(phase.bank_deg * kDegree) * std::min(speed_ / (kSlowest * kSlowest), 1 / speed_);
    if (!phase.circle) return std::clamp(to_waypoint(phase), -most, most);
    return side_ * std::min(most, speed_ / turn_radius(phase, std::max(phase.speed, kSlowest), gravity_));
  }

  double course_to(const Eigen::Vector2d& place) const { return std::atan2(place.y() - p_.y(), place.x() - p_.x()); }

  // Rate of turn towards the next waypoint, or the one after when it is time to turn.
  double to_waypoint(const Phase& phase) {
    const Waypoint& here = circuit_[next_];
    const Waypoint& after = circuit_[(next_ + 1) % circuit_.size()];
    const Eigen::Vector2d before = circuit_[(next_ + circuit_.size() - 1) % circuit_.size()].p;
    const Eigen::Vector2d in = (here.p - before).normalized(), out = (after.p - here.p).normalized();
    const double corner = std::acos(std::clamp(in.dot(out), -1.0, 1.0));
    const double fastest = std::max(speed_, phase.speed * after.speed);
    const double lead = turn_radius(phase, fastest, gravity_) * std::tan(0.5 * std::min(corner, 2.0)) + 0.5 * fastest;
    if (in.dot(here.p - p_) < lead) next_ = (next_ + 1) % circuit_.size();
    return kCourseHold * wrap_angle(course_to(circuit_[next_].p) - course_);
  }

  const FlightOptions& options_;
  const FlightArea& area_;
  double gravity_, ground_offset_;
  std::vector<Waypoint> circuit_;
  Eigen::Vector2d centre_;
  size_t next_ = 1;
  Eigen::Vector2d p_, landing_ = Eigen::Vector2d::Zero();
  double z_ = 0, speed_ = 0, course_ = 0, yaw_ = 0, side_ = 1;
  bool standing_ = false;  // on the ground, where nothing moves
  double clear_ = kNever;  // m in G, up to where it rises straight
};

}  // namespace

OrderedFlight fly_phases(const FlightOptions& options, const FlightArea& area, double gravity, double ground_offset,
                         uint64_t seed) {
  if (options.phases.front().height_m <= 0) {
    throw std::invalid_argument(
        fmt::format("flight.phases.{}: the first is flown, not stood", options.phases.front().name));
  }
  Pilot pilot(options, area, gravity, ground_offset, lay_circuit(options, area, gravity, seed));
  std::vector<Phase> phases = options.phases;
  if (options.take_off) {
    pilot.start_on_ground();
    Phase stand = phases.front(), rise = phases.front();
    stand.speed = rise.speed = stand.spin_deg = rise.spin_deg = 0;
    stand.seconds = options.standstill_s;
    stand.height_m = 0;
    rise.climb_speed = options.climb_speed;
    rise.seconds = (area.ground_height + rise.height_m - pilot.ground()) / options.climb_speed + kSettle;
    phases.insert(phases.begin(), {stand, rise});
  } else {
    pilot.start_in_flight(phases.front());
  }
  constexpr double kStep = SampledMotion<Eigen::Vector4d>::kStep;
  std::vector<Eigen::Vector4d> samples;
  double end = 0, t = 0;
  for (size_t i = 0; i < phases.size(); ++i) {
    end += phases[i].seconds;
    pilot.begin(phases[i]);
    for (; t < end + (i + 1 == phases.size() ? kPastTheEnd : 0.0); t += kStep) {
      samples.push_back(pilot.state());
      pilot.step(phases[i], kStep);
    }
  }
  return {SampledMotion<Eigen::Vector4d>(std::move(samples)), end};
}

}  // namespace orthonav::simulate
