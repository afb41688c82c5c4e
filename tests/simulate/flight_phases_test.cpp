// Flights by orders.
#include <algorithm>
#include <numbers>

#include <fmt/format.h>
#include <gtest/gtest.h>

#include "common/math/angles.h"
#include "tests/simulate/flight_fixtures.h"
#include "tools/simulate/flight_plan.h"

namespace orthonav::simulate {
namespace {

constexpr double kGravity = 9.81;

// Without wind, gusts, wander and jitter: what was ordered and nothing else.
FlightOptions calm(std::vector<Phase> phases) {
  FlightOptions o;
  o.wander_stddev_m = o.height_stddev_m = o.wind_speed = o.yaw_wander_deg = o.attitude_jitter_deg = o.leg_speed_spread =
      0;
  o.drag = 0.001;
  o.acceleration = 3;
  o.phases = std::move(phases);
  return o;
}

TEST(Phases, ACircleHasTheRateTheRadiusAndTheTiltOfItsBank) {
  Phase circle{.name = "circle", .seconds = 60, .speed = 15, .bank_deg = 30, .circle = true};
  const Trajectory flight = plan_flight(calm({circle}), flat_area(510, 400), kGravity, 1);
  const double rate = kGravity * std::tan(30 * kDegree) / 15, radius = 15 / rate;
  const Eigen::Vector3d p = flight.at(20).p_G_B, opposite = flight.at(20 + std::numbers::pi / rate).p_G_B;
  EXPECT_NEAR((p - opposite).norm(), 2 * radius, 0.05 * 2 * radius);
  for (const double t : range(5, 55, 0.7)) {
    const MotionState state = flight.at(t);
    EXPECT_NEAR(state.v_G_B.norm(), 15, 0.03 * 15);
    EXPECT_NEAR(state.tilt() / kDegree, 30, 1.0);
    EXPECT_NEAR(std::abs((state.R_G_B * state.angular_rate).z()), rate, 0.01 * rate);
    // Coordinated: nothing is felt sideways, the nose points along the way.
    EXPECT_NEAR(state.specific_force.y(), 0, 0.05);
    EXPECT_GT(state.R_G_B.col(0).dot(state.v_G_B.normalized()), std::cos(2 * kDegree));
  }
}

TEST(Phases, LanesAreFlownAtTheirSpeedAndBankOverTheMap) {
  for (const double speed : {3.0, 15.0, 25.0}) {
    Phase fly{.name = "fly", .seconds = 150, .speed = speed, .bank_deg = 30};
    for (const uint64_t seed : {1, 2, 3}) {
      FlightOptions options = calm({fly});
      options.leg_speed_spread = 0.1;
      const Trajectory flight = plan_flight(options, flat_area(900, 700), kGravity, seed);
      double turned = 0, steepest = 0, nearest_border = 1e9;
      for (const double t : range(0, 150, 0.2)) {
        const MotionState state = flight.at(t);
        EXPECT_NEAR(state.v_G_B.norm(), speed, 0.15 * speed);
        const Eigen::Vector3d& p = state.p_G_B;
        nearest_border = std::min({nearest_border, p.x(), 900 - p.x(), -p.y(), 700 + p.y()});
        steepest = std::max(steepest, state.tilt());
        turned += 0.2 * std::abs(state.angular_rate.z());
      }
      EXPECT_GT(nearest_border, options.border_margin_m - 10) << speed << " m/s, seed " << seed;
      EXPECT_LT(steepest, 32 * kDegree);
      if (speed > 10) {
        EXPECT_GT(steepest, 27 * kDegree);
        EXPECT_GT(turned, std::numbers::pi);
      }
    }
  }
}

TEST(Phases, SpinsAndHoversOverOnePlace) {
  Phase spin{.name = "spin", .seconds = 20, .speed = 0, .spin_deg = 60};
  Phase hover = spin;
  hover.spin_deg = 0;
  const Trajectory flight = plan_flight(calm({spin, hover}), flat_area(510, 400), kGravity, 1);
  for (const double t : range(0, 40, 0.5)) {
    const MotionState state = flight.at(t);
    EXPECT_LT((state.p_G_B - flight.at(0).p_G_B).norm(), 0.01);
    if (t > 15 && t < 30) continue;  // from the one to the other
    EXPECT_NEAR(state.angular_rate.z(), t <= 15 ? 60 * kDegree : 0, 1e-6) << t;
  }
}

TEST(Phases, ClimbsAndDescendsInFlight) {
  Phase low{.name = "low", .seconds = 20, .speed = 5};
  Phase high = low, back = low;
  high.height_m = 160;
  high.seconds = 40;
  high.climb_speed = 4;
  back.seconds = 60;
  const Trajectory flight = plan_flight(calm({low, high, back}), flat_area(510, 400, 7), kGravity, 1);
  EXPECT_NEAR(flight.at(10).p_G_B.z(), 117, 0.01);
  EXPECT_NEAR(flight.at(26).v_G_B.z(), 4, 0.01);
  EXPECT_NEAR(flight.at(50).p_G_B.z(), 167, 0.01);
  EXPECT_NEAR(flight.at(70).v_G_B.z(), -3, 0.01);
  EXPECT_NEAR(flight.at(110).p_G_B.z(), 117, 0.01);
  EXPECT_NEAR(flight.at(30).v_G_B.head<2>().norm(), 5, 0.3);
}

TEST(Phases, TakeOffStandsRisesAndGoesOnAndLandingEndsOnTheGround) {
  Phase hover{.name = "hover", .seconds = 10, .speed = 0};
  Phase land = hover;
  land.seconds = 60;
  land.height_m = 0;
  FlightOptions options = calm({hover, land});
  options.take_off = true;
  FlightArea area = flat_area(510, 400);
  // Stripes of roofs, 8 m wide.
  area.surface = [](const Eigen::Vector2d& p) { return std::fmod(p.x() + 1000, 16) < 8 ? 6.0 : 0.0; };
  const Trajectory flight = plan_flight(options, area, kGravity, 1);
  for (const double t : {1.0, flight.duration() - 5.0}) {
    const MotionState state = flight.at(t);
    EXPECT_NEAR(state.p_G_B.z(), 0.15, 0.01) << "beside the roofs";
    EXPECT_LT(state.v_G_B.norm(), 1e-6);
    EXPECT_LT((state.specific_force - Eigen::Vector3d(0, 0, kGravity)).norm(), 1e-6);
  }
  EXPECT_NEAR(flight.at(options.standstill_s + 20).v_G_B.z(), options.climb_speed, 0.01);
  EXPECT_NEAR(flight.at(options.standstill_s + 110.0 / options.climb_speed + 6).p_G_B.z(), 110, 0.1);
}

// A hillside, falling to the south-west.
FlightArea hillside() {
  FlightArea area = flat_area(510, 400);
  area.surface = [](const Eigen::Vector2d& p) { return 0.1 * (p.x() - 255) + 0.05 * (p.y() + 200); };
  return area;
}

void expect_standing(const Trajectory& flight, double from, double to) {
  const MotionState first = flight.at(from);
  EXPECT_NEAR(first.p_G_B.z(), hillside().surface(first.p_G_B.head<2>()) + 0.15, 0.001);
  for (const double t : range(from, to, 0.1)) {
    const MotionState state = flight.at(t);
    EXPECT_LT((state.p_G_B - first.p_G_B).norm(), 1e-6) << t;
    EXPECT_LT(state.v_G_B.norm(), 1e-6) << t;
    EXPECT_LT(state.angular_rate.norm(), 1e-6) << t;
    EXPECT_LT((state.specific_force - Eigen::Vector3d(0, 0, kGravity)).norm(), 1e-6) << t;
  }
}

TEST(Phases, StandStillOnSlopingGroundWhateverComesFirst) {
  for (const bool circle : {false, true}) {
    for (const double speed : {0.0, 8.0}) {
      for (const double spin : {0.0, 60.0}) {
        Phase first{.name = "first", .seconds = 30, .speed = speed, .circle = circle, .spin_deg = spin};
        FlightOptions options = calm({first});
        options.take_off = true;
        options.standstill_s = 10;
        options.wind_speed = 5;  // of which an aircraft on the ground feels nothing
        options.wander_stddev_m = options.attitude_jitter_deg = options.yaw_wander_deg = 1;
        SCOPED_TRACE(fmt::format("circle {}, {} m/s, spin {}", circle, speed, spin));
        expect_standing(plan_flight(options, hillside(), kGravity, 1), 0, options.standstill_s - 3.5);
      }
    }
  }
}

TEST(Phases, StandStillAfterALandingFromFlightAndRiseStraightAgain) {
  Phase fly{.name = "fly", .seconds = 30, .speed = 8, .spin_deg = 30};
  Phase land = fly, again = fly;
  land.seconds = 80;
  land.height_m = 0;
  const Trajectory flight = plan_flight(calm({fly, land, again}), hillside(), kGravity, 1);
  expect_standing(flight, 95, 106);
  const MotionState stood = flight.at(100), clear = flight.at(111);
  EXPECT_LT((clear.p_G_B - stood.p_G_B).head<2>().norm(), 0.05) << "straight up";
  EXPECT_GT(clear.p_G_B.z(), stood.p_G_B.z() + 2);
  EXPECT_NEAR(flight.at(130).v_G_B.head<2>().norm(), 8, 0.5);
}

TEST(FlightPlan, ASurveyStandsStillOnSlopingGroundToo) {
  FlightOptions options;
  options.take_off = true;
  options.standstill_s = 10;
  expect_standing(plan_flight(options, hillside(), kGravity, 1), 0, options.standstill_s - 3.5);
}

TEST(Phases, ACircleAtNoSpeedHoversWithoutATurn) {
  Phase circle{.name = "circle", .seconds = 40, .speed = 8, .circle = true};
  Phase hover = circle;
  hover.speed = 0;
  const Trajectory flight = plan_flight(calm({hover, circle, hover}), flat_area(510, 400), kGravity, 1);
  for (const double t : range(0, 35, 0.5)) EXPECT_LT(flight.at(t).angular_rate.norm(), 1e-6) << t;
  EXPECT_NEAR(std::abs(flight.at(60).angular_rate.norm()), kGravity * std::tan(15 * kDegree) / 8, 0.01);
  for (const double t : range(95, 120, 0.5)) {
    EXPECT_LT(flight.at(t).angular_rate.norm(), 1e-6) << t;
    EXPECT_LT(flight.at(t).v_G_B.norm(), 1e-6) << t;
  }
}

TEST(Phases, AFlightThatBeginsWithALandingIsRefused) {
  Phase land{.name = "land", .height_m = 0};
  EXPECT_THROW(plan_flight(calm({land}), flat_area(510, 400), kGravity, 1), std::invalid_argument);
}

TEST(Phases, TurnsThatDoNotFitOverTheMapAreRefused) {
  Phase fast{.name = "fast", .seconds = 60, .speed = 25, .bank_deg = 15};
  EXPECT_THROW(plan_flight(calm({fast}), flat_area(510, 400), kGravity, 1), std::invalid_argument);
}

TEST(Phases, AreReadInOrderEachGoingOnAsTheOneBefore) {
  ConfigNode node = ConfigNode::parse(
      "height_m: 90\nphases: {names: [a, b], a: {seconds: 7, speed: 9}, b: {height_m: 40, spin_deg: -30}}", "test");
  const FlightOptions options = FlightOptions::from_config(node);
  ASSERT_EQ(options.phases.size(), 2U);
  EXPECT_EQ(options.phases[0].height_m, 90);
  EXPECT_EQ(options.phases[1].seconds, 7);
  EXPECT_EQ(options.phases[1].speed, 9);
  EXPECT_EQ(options.phases[1].height_m, 40);
  EXPECT_EQ(options.phases[1].spin_deg, -30);
  ConfigNode unknown = ConfigNode::parse("phases: {names: [a], a: {sped: 9}}", "test");
  EXPECT_THROW(FlightOptions::from_config(unknown), ConfigError);
}

}  // namespace
}  // namespace orthonav::simulate
