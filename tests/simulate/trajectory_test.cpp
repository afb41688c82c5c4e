#include "tools/simulate/trajectory.h"

#include <algorithm>

#include <gtest/gtest.h>

#include "common/math/angles.h"
#include "common/math/so3.h"
#include "tests/simulate/flight_fixtures.h"
#include "tools/simulate/flight_plan.h"
#include "tools/simulate/random_stream.h"

namespace orthonav::simulate {
namespace {

constexpr double kGravity = 9.81;

Trajectory plan(const std::string& scenario, double width, double depth, uint64_t seed, bool take_off = false) {
  FlightOptions options = Scenario::load(config_folder(scenario)).flight;
  options.take_off = take_off;
  return plan_flight(options, flat_area(width, depth), kGravity, seed);
}

Trajectory rural(uint64_t seed, bool take_off = false) {
  return plan("rural", 510, 400, seed, take_off);
}

TEST(UniformSpline, ReproducesStraightLinesAndDifferentiatesThem) {
  std::vector<UniformSpline<1>::Point> control(20);
  for (size_t i = 0; i < control.size(); ++i) control[i][0] = 3.0 + 0.5 * static_cast<double>(i);
  const UniformSpline<1> line(10.0, 0.25, control);  // 3 + 2 (t - 10)
  for (const double t : {10.75, 11.0, 12.345, 13.7}) {
    EXPECT_NEAR(line.evaluate(t)[0], 3.0 + 2.0 * (t - 10.0), 1e-12);
    EXPECT_NEAR(line.evaluate(t, 1)[0], 2.0, 1e-11);
    EXPECT_NEAR(line.evaluate(t, 2)[0], 0.0, 1e-9);
  }
  EXPECT_THROW(line.evaluate(10.7), std::out_of_range);
  EXPECT_THROW(line.evaluate(14.1), std::out_of_range);
}

TEST(UniformSpline, EveryDerivativeIsThatOfTheOneBelow) {
  RandomStream stream(3, "spline");
  std::vector<UniformSpline<1>::Point> control(30);
  for (auto& point : control) point[0] = stream.gaussian();
  const UniformSpline<1> spline(0.0, 0.5, control);
  const double h = 1e-4;
  for (int derivative = 0; derivative < 5; ++derivative) {
    for (const double t : range(2.0, 12.0, 0.37)) {
      const double slope = (spline.evaluate(t + h, derivative)[0] - spline.evaluate(t - h, derivative)[0]) / (2 * h);
      EXPECT_NEAR(spline.evaluate(t, derivative + 1)[0], slope, 1e-5 * std::pow(2.0, derivative + 2)) << derivative;
    }
  }
}

TEST(Trajectory, VelocityAccelerationAndAngularRateAreDerivatives) {
  const Trajectory flight = rural(1);
  const double h = 1e-4;
  for (const double t : range(0.5, flight.duration(), 3.71)) {
    const MotionState before = flight.at(t - h), now = flight.at(t), after = flight.at(t + h);
    EXPECT_LT((now.v_G_B - (after.p_G_B - before.p_G_B) / (2 * h)).norm(), 1e-6);
    EXPECT_LT((now.a_G_B - (after.v_G_B - before.v_G_B) / (2 * h)).norm(), 1e-6);
    const Eigen::Quaterniond turn(Eigen::Matrix3d(before.R_G_B.transpose() * after.R_G_B));
    EXPECT_LT((now.angular_rate - so3_log(turn) / (2 * h)).norm(), 1e-5);
    EXPECT_LT((now.R_G_B.transpose() * now.R_G_B - Eigen::Matrix3d::Identity()).norm(), 1e-12);
    EXPECT_NEAR(now.R_G_B.determinant(), 1.0, 1e-12);
  }
}

// Position after integrating 60 s of exact samples of angular rate and specific force, minus the true one.
MotionState integration_error(const Trajectory& flight, double rate_hz) {
  const double step = 2.0 / rate_hz;
  const int steps = static_cast<int>(60.0 / step);
  MotionState state = flight.at(0);
  Eigen::Quaterniond q(state.R_G_B);
  const Eigen::Vector3d g(0, 0, -kGravity);
  MotionState a = state;
  for (int i = 0; i < steps; ++i) {
    const MotionState b = flight.at((i + 0.5) * step), c = flight.at((i + 1) * step);
    const auto turn = [](const Eigen::Vector3d& w0, const Eigen::Vector3d& w1, double dt) {
      return so3_exp(0.5 * dt * (w0 + w1) + dt * dt / 12.0 * w0.cross(w1));  // Magnus
    };
    const Eigen::Quaterniond q_b = q * turn(a.angular_rate, b.angular_rate, 0.5 * step);
    const Eigen::Quaterniond q_c = q_b * turn(b.angular_rate, c.angular_rate, 0.5 * step);
    const Eigen::Vector3d a0 = q * a.specific_force + g, a1 = q_b * b.specific_force + g,
                          a2 = q_c * c.specific_force + g;
    state.p_G_B += step * state.v_G_B + step * step / 6.0 * (a0 + 2.0 * a1);  // Simpson
    state.v_G_B += step / 6.0 * (a0 + 4.0 * a1 + a2);
    q = q_c.normalized();
    a = c;
  }
  state.p_G_B -= a.p_G_B;
  state.v_G_B -= a.v_G_B;
  state.R_G_B = q.toRotationMatrix() * a.R_G_B.transpose();
  return state;
}

TEST(Trajectory, IntegratingWhatTheInertialSensorFeelsReturnsThePath) {
  const Trajectory flight = rural(2);
  const MotionState at_200_hz = integration_error(flight, 200), at_1_khz = integration_error(flight, 1000);
  EXPECT_LT(at_200_hz.p_G_B.norm(), 0.03);
  EXPECT_LT(at_200_hz.v_G_B.norm(), 2e-3);
  EXPECT_LT(so3_log(Eigen::Quaterniond(at_200_hz.R_G_B)).norm(), 1e-5);
  // What is left is the integration's: the trapezoids of the angular rate are of second order.
  EXPECT_LT(at_1_khz.p_G_B.norm(), at_200_hz.p_G_B.norm() / 15);
}

struct Figures {
  const char* scenario;
  double width, depth, seconds, length, height, tilt_deg;
};

class PaperFlight : public testing::TestWithParam<Figures> {};

TEST_P(PaperFlight, HasTheFiguresOfThePaper) {
  const Figures& paper = GetParam();
  for (const uint64_t seed : {1, 2, 3}) {
    const Trajectory flight = plan(paper.scenario, paper.width, paper.depth, seed);
    EXPECT_DOUBLE_EQ(flight.duration(), paper.seconds);
    EXPECT_NEAR(flight.path_length(), paper.length, 0.002 * paper.length) << seed;
    EXPECT_NEAR(flight.mean_tilt() / kDegree, paper.tilt_deg, 0.01) << seed;
    double height = 0;
    int samples = 0;
    for (const double t : range(0, flight.duration(), 0.5)) {
      height += flight.at(t).p_G_B.z();
      ++samples;
    }
    EXPECT_NEAR(height / samples, paper.height, 2.0) << seed;
  }
}

TEST_P(PaperFlight, StaysOverTheMap) {
  const Figures& paper = GetParam();
  const double margin = Scenario::load(config_folder(paper.scenario)).flight.border_margin_m - 3.0;
  for (const uint64_t seed : {1, 2, 3, 4, 5, 6, 7, 8}) {
    const Trajectory flight = plan(paper.scenario, paper.width, paper.depth, seed);
    for (const double t : range(0, flight.duration(), 0.5)) {
      const Eigen::Vector3d p = flight.at(t).p_G_B;
      ASSERT_GT(p.x(), margin) << seed << " at " << t;
      ASSERT_LT(p.x(), paper.width - margin) << seed << " at " << t;
      ASSERT_LT(p.y(), -margin) << seed << " at " << t;
      ASSERT_GT(p.y(), -paper.depth + margin) << seed << " at " << t;
    }
  }
}

// Neither a glide, which would hide the scale from the odometry, nor an exercise that would give it away.
TEST_P(PaperFlight, MovesLikeAMultirotorInWind) {
  const Figures& paper = GetParam();
  const Trajectory flight = plan(paper.scenario, paper.width, paper.depth, 1);
  double square = 0, rate_square = 0, most = 0, fastest = 0;
  int samples = 0;
  for (const double t : range(0, flight.duration(), 0.05)) {
    ++samples;
    const MotionState state = flight.at(t);
    square += state.a_G_B.squaredNorm();
    rate_square += state.angular_rate.squaredNorm();
    most = std::max(most, state.a_G_B.norm());
    fastest = std::max(fastest, state.v_G_B.norm());
  }
  const double acceleration = std::sqrt(square / samples), rate = std::sqrt(rate_square / samples);
  RecordProperty("acceleration_rms", std::to_string(acceleration));
  RecordProperty("acceleration_max", std::to_string(most));
  RecordProperty("angular_rate_rms", std::to_string(rate));
  RecordProperty("speed_max", std::to_string(fastest));
  EXPECT_GT(acceleration, 0.2);
  EXPECT_LT(acceleration, 1.0);
  EXPECT_LT(most, 4.0);
  EXPECT_GT(rate, 2 * kDegree);
  EXPECT_LT(rate, 12 * kDegree);
  EXPECT_LT(fastest, 2.5 * paper.length / paper.seconds);
}

INSTANTIATE_TEST_SUITE_P(, PaperFlight,
                         testing::Values(Figures{"rural", 510, 400, 448.2, 1180, 110, 5.63},
                                         Figures{"testing_zone", 1460, 1450, 407.5, 2450, 285, 7.80}),
                         [](const auto& parameter) { return parameter.param.scenario; });

TEST(FlightPlan, TakesOffFromStandstill) {
  const FlightOptions options = Scenario::load(config_folder("rural")).flight;
  const Trajectory flight = rural(4, true);
  EXPECT_GT(flight.duration(), options.duration_s + options.standstill_s + options.height_m / options.climb_speed);
  for (const double t : range(0, options.standstill_s - 3.5, 0.1)) {
    const MotionState state = flight.at(t);
    EXPECT_LT(state.v_G_B.norm(), 1e-9);
    EXPECT_LT(state.angular_rate.norm(), 1e-9);
    EXPECT_LT((state.specific_force - Eigen::Vector3d(0, 0, kGravity)).norm(), 1e-9);
  }
  EXPECT_LT(flight.at(1).p_G_B.z(), 0.5);
  double lowest = 1e9;
  for (const double t : range(flight.duration() - options.duration_s, flight.duration(), 1)) {
    lowest = std::min(lowest, flight.at(t).p_G_B.z());
  }
  EXPECT_GT(lowest, options.height_m - 8.0);
}

TEST(FlightPlan, TakesOffBesideTheRoofThatItWouldStandOn) {
  FlightOptions options;
  options.take_off = true;
  FlightArea area = flat_area(510, 400);
  // Stripes of roofs, 8 m wide.
  area.surface = [](const Eigen::Vector2d& p) { return std::fmod(p.x() + 1000, 16) < 8 ? 6.0 : 0.0; };
  for (const uint64_t seed : {1, 2, 3}) {
    const Trajectory flight = plan_flight(options, area, kGravity, seed);
    EXPECT_LT(flight.at(0).p_G_B.z(), 1.0);
  }
}

TEST(FlightPlan, DependsOnTheSeedAlone) {
  for (const double t : {0.0, 100.0, 400.0}) {
    EXPECT_EQ(rural(7).at(t).p_G_B, rural(7).at(t).p_G_B);
    EXPECT_EQ(rural(7).at(t).angular_rate, rural(7).at(t).angular_rate);
    EXPECT_GT((rural(7).at(t).p_G_B - rural(8).at(t).p_G_B).norm(), 1.0);
  }
}

TEST(FlightPlan, RefusesWhatCannotBeFlown) {
  FlightOptions options;
  EXPECT_THROW(plan_flight(options, flat_area(160, 160), kGravity, 1), std::invalid_argument);
  options.mean_tilt_deg = 0.5;
  EXPECT_THROW(plan_flight(options, flat_area(510, 400), kGravity, 1), std::invalid_argument);
  options = FlightOptions();
  options.duration_s = 20;
  options.length_m = 10000;
  EXPECT_THROW(plan_flight(options, flat_area(510, 400), kGravity, 1), std::invalid_argument);
}

}  // namespace
}  // namespace orthonav::simulate
