// What the fusion does when parts of the aircraft fail in flight.
#include <gtest/gtest.h>

#include "tests/fusion/faults.h"
#include "tests/fusion/fly.h"

namespace orthonav::fusion {
namespace {

SyntheticOptions two_minutes() {
  SyntheticOptions options;
  options.duration = 120.0;
  options.keyframe_interval = 0.5;
  options.single_wrong_rate = 0.0;
  options.imu = true;
  return options;
}

// Horizontal error at a state, m; NaN without a position.
double error_at(const SyntheticFlight& flight, const Flown& flown, size_t state) {
  const Solution& solution = flown.solutions[state];
  if (!solution.located()) return std::nan("");
  return (EnuFrame(flight.anchor).to_enu(solution.position) - flight.truth[state]).head<2>().norm();
}

TEST(Scenario, AMinuteWithoutRegistrationIsCoastedAndReacquired) {
  SyntheticFlight flight = make_flight(two_minutes(), 11);
  faults::silence_fixes(flight, 40.0, 100.0);
  const Flown flown = fly(flight, FusionOptions{});
  EXPECT_EQ(flown.solutions[390].mode, Mode::kMapAided);
  EXPECT_EQ(flown.solutions[980].mode, Mode::kCoasting);
  EXPECT_GT(flown.solutions[980].covariance(0, 0), flown.solutions[390].covariance(0, 0));
  EXPECT_LT(error_at(flight, flown, 980), 8.0);
  EXPECT_EQ(flown.solutions[1050].mode, Mode::kMapAided);
  EXPECT_LE(flown.solutions.back().reset_counter, 2) << "at most the correction of what had drifted";
  EXPECT_EQ(flown.misleading_horizontal + flown.misleading_vertical, 0);
}

TEST(Scenario, AnOdometryThatRestartsIsBridgedByTheInertialSensor) {
  SyntheticFlight flight = make_flight(two_minutes(), 12);
  faults::restart_odometry(flight, 60.0, 3.0);
  const Flown flown = fly(flight, FusionOptions{});
  for (size_t k = 600; k < 640; ++k) {
    EXPECT_TRUE(flown.solutions[k].located()) << k;
    EXPECT_LT(error_at(flight, flown, k), 6.0) << k;
    EXPECT_TRUE(k < 612 || std::isnan(flown.solutions[k].horizontal_protection_level)) << k;
  }
  EXPECT_EQ(flown.solutions[625].mode, Mode::kCoasting);
  EXPECT_EQ(flown.solutions.back().mode, Mode::kMapAided);
  EXPECT_EQ(flown.solutions.back().session, 2);
  EXPECT_LT(error_at(flight, flown, flown.solutions.size() - 1), 4.0);
  EXPECT_EQ(flown.misleading_horizontal + flown.misleading_vertical, 0);
}

TEST(Scenario, AnOdometryThatIsGoneForLongLosesThePositionAndFindsItAgain) {
  SyntheticFlight flight = make_flight(two_minutes(), 13);
  faults::restart_odometry(flight, 60.0, 15.0);
  const Flown flown = fly(flight, FusionOptions{});
  EXPECT_EQ(flown.solutions[740].mode, Mode::kLost);
  EXPECT_FALSE(flown.solutions[740].located());
  EXPECT_GT(flown.solutions[740].reset_counter, flown.solutions[590].reset_counter);
  EXPECT_EQ(flown.solutions.back().mode, Mode::kMapAided);
  EXPECT_LT(error_at(flight, flown, flown.solutions.size() - 1), 4.0);
}

// For ten seconds the odometry flies another aircraft's way, and nothing of it is on the map.
TEST(Scenario, AnOdometryThatLosesSightOfAllItSawIsDoubtedAtOnceAndLeftWithTheFirstSureFix) {
  for (uint64_t seed = 21; seed <= 23; ++seed) {
    SyntheticFlight flight = make_flight(two_minutes(), seed);
    for (Fix& fix : flight.fixes) fix.log_odds = 9.0;
    flight.states[600].has_tracks = flight.states[700].has_tracks = false;
    faults::bend_odometry(flight, 60.0, 3.0, 1.5);
    faults::bend_odometry(flight, 70.0, 1.0 / 3.0, -1.5);
    faults::silence_fixes(flight, 59.8, 72.0);
    const Flown flown = fly(flight, FusionOptions{});
    EXPECT_EQ(flown.solutions[598].mode, Mode::kMapAided);
    double largest = 0.0;
    for (size_t k = 600; k < 720; ++k) {
      const Mode mode = flown.solutions[k].mode;
      EXPECT_TRUE(mode == Mode::kCoasting || mode == Mode::kLost) << k;
      EXPECT_TRUE(std::isnan(flown.solutions[k].horizontal_protection_level)) << k;
      const double stddev = horizontal_stddev(flown.solutions[k].covariance.topLeftCorner<3, 3>());
      EXPECT_LT(error_at(flight, flown, k), 2.0 * stddev + 3.0) << k;
      largest = std::max(largest, error_at(flight, flown, k));
    }
    EXPECT_GT(largest, 40.0) << "or nothing was tried";
    for (size_t k = 745; k < flown.solutions.size(); ++k) EXPECT_LT(error_at(flight, flown, k), 5.0) << k;
    EXPECT_EQ(flown.solutions[800].mode, Mode::kMapAided);
    EXPECT_LE(flown.solutions.back().reset_counter, 2);
    EXPECT_EQ(flown.misleading_horizontal + flown.misleading_vertical, 0);
  }
}

// A dark image or two, with the aircraft's own sensors all the while.
TEST(Scenario, ALookAwayIsOverWithTheNextFix) {
  SyntheticFlight flight = make_flight(two_minutes(), 24);
  const Flown whole = fly(flight, FusionOptions{});
  flight.states[600].has_tracks = flight.states[601].has_tracks = false;
  const Flown flown = fly(flight, FusionOptions{});
  EXPECT_EQ(flown.solutions[601].mode, Mode::kCoasting);
  EXPECT_EQ(flown.solutions[630].mode, Mode::kMapAided);
  EXPECT_LE(flown.solutions.back().reset_counter, whole.solutions.back().reset_counter + 1);
  EXPECT_LT(flown.rmse, whole.rmse + 0.2);
}

TEST(Scenario, ACompassTwentyDegreesOffIsFoundOut) {
  SyntheticFlight flight = make_flight(two_minutes(), 14);
  faults::turn_compass(flight, 0.0, 1e9, 0.349);
  const Flown flown = fly(flight, FusionOptions{});
  const Solution& end = flown.solutions.back();
  EXPECT_EQ(end.mode, Mode::kMapAided);
  const double heading = wrap_angle(heading_of(end.q_G_B) - heading_of(flight.truth_q.back()));
  EXPECT_LT(std::abs(heading), 0.035);
  EXPECT_NEAR(end.compass_bias, 0.349, 0.13);  // the flight's own bias is 0.05, 1 sigma
  EXPECT_LT(error_at(flight, flown, flown.solutions.size() - 1), 4.0);
}

TEST(Scenario, ACompassThatDiesIsNotMissed) {
  SyntheticFlight flight = make_flight(two_minutes(), 15);
  const Flown whole = fly(flight, FusionOptions{});
  faults::silence_compass(flight, 40.0, 1e9);
  const Flown flown = fly(flight, FusionOptions{});
  EXPECT_EQ(flown.solutions.back().mode, Mode::kMapAided);
  EXPECT_LT(flown.heading_rmse, whole.heading_rmse + 0.005);
  EXPECT_LT(flown.horizontal_rmse, whole.horizontal_rmse + 0.3);
}

TEST(Scenario, InertialStatesComeAtTheSensorsRateAndAreAsGood) {
  const SyntheticFlight flight = make_flight(two_minutes(), 16);
  const Flown flown = fly(flight, FusionOptions{});
  ASSERT_GT(flown.inertial.size(), 20'000U);
  EXPECT_EQ(flown.inertial[1001].utime - flown.inertial[1000].utime, 5000);
  const EnuFrame frame(flight.anchor);
  size_t image = 0;
  std::vector<double> errors;
  for (const Solution& solution : flown.inertial) {
    EXPECT_TRUE(solution.inertial);
    while (image < flight.states.size() && flight.states[image].utime < solution.utime) ++image;
    if (image == flight.states.size() || flight.states[image].utime != solution.utime) continue;
    errors.push_back((frame.to_enu(solution.position) - flight.truth[image]).norm());
  }
  EXPECT_LT(root_mean_square(errors), flown.rmse + 0.2);
}

// High up an error of the vertical is most of what fixes err by.
SyntheticOptions leaning() {
  SyntheticOptions options = two_minutes();
  options.duration = 180.0;
  options.height = 285.0;
  options.speed = 6.0;
  options.fix_stddev = options.fix_vertical_stddev = 0.3;
  options.fix_shared_stddev = options.fix_shared_vertical_stddev = 0.3;
  options.position_noise = 0.005;
  options.imu = false;
  options.lean = Eigen::Vector2d(0.0062, -0.0062);  // 0.5 degrees, 2.5 m on the ground
  return options;
}

// Horizontal errors from a time on, s, m RMS.
double horizontal_rmse_from(const SyntheticFlight& flight, const Flown& flown, double from) {
  std::vector<double> errors;
  for (size_t k = static_cast<size_t>(10.0 * from); k < flown.solutions.size(); ++k) {
    errors.push_back(error_at(flight, flown, k));
  }
  return root_mean_square(errors);
}

TEST(Scenario, AVerticalThatNothingTellsIsNoWorseThanItsFixesAndWithinItsLevel) {
  for (uint64_t seed = 1; seed <= 3; ++seed) {
    const SyntheticFlight flight = make_flight(leaning(), seed);
    const Flown flown = fly(flight, FusionOptions{});
    EXPECT_LT(horizontal_rmse_from(flight, flown, 60.0), 2.5) << "seed " << seed;
    EXPECT_EQ(flown.misleading_horizontal + flown.misleading_vertical, 0) << "seed " << seed;
  }
}

TEST(Scenario, AVerticalThatLeansIsFoundInTheFixesPerspective) {
  SyntheticOptions options = leaning();
  options.perspective_stddev = 0.003;
  for (uint64_t seed = 1; seed <= 3; ++seed) {
    const SyntheticFlight flight = make_flight(options, seed);
    const Flown flown = fly(flight, FusionOptions{});
    EXPECT_LT(horizontal_rmse_from(flight, flown, 15.0), 1.0) << "seed " << seed;
    EXPECT_EQ(flown.misleading_horizontal + flown.misleading_vertical, 0) << "seed " << seed;
  }
}

}  // namespace
}  // namespace orthonav::fusion
