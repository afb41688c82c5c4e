// Propagation by the inertial sensor, against the path that its samples were made from.
#include "services/fusion/inertial.h"

#include <algorithm>

#include <gtest/gtest.h>

#include "common/math/so3.h"
#include "tests/fusion/synthetic_flight.h"

namespace orthonav::fusion {
namespace {

class InertialOnAFlight : public ::testing::Test {
 protected:
  InertialOnAFlight() {
    SyntheticOptions options;
    options.duration = 20.0;
    options.imu = true;
    options.position_noise = options.heading_walk = options.scale_walk = 0.0;
    flight_ = make_flight(options, 3);
  }
  // The truth at an image, with the biases that the odometry would give.
  InertialState truth(size_t image) const {
    InertialState state;
    state.utime = flight_.states[image].utime;
    state.p_G_B = flight_.truth[image];
    state.q_G_B = flight_.truth_q[image];
    state.v_G_B = (flight_.truth[image + 1] - flight_.truth[image - 1]) / 0.2;
    return state;
  }
  void rebase(size_t image) {
    inertial_.rebase(truth(image), flight_.states[image].gyro_bias, flight_.states[image].accel_bias);
  }
  void add_until(size_t image) {
    while (next_ < flight_.imu.size() && flight_.imu[next_].utime <= flight_.states[image].utime) {
      EXPECT_EQ(inertial_.add(flight_.imu[next_++]), Outcome::kUsed);
    }
  }
  SyntheticFlight flight_;
  Inertial inertial_{InertialOptions{}};
  size_t next_ = 0;
};

TEST_F(InertialOnAFlight, FollowsThePathWithinItsOwnUncertainty) {
  add_until(50);
  rebase(50);
  add_until(80);  // three seconds on
  const auto state = inertial_.newest();
  ASSERT_TRUE(state);
  EXPECT_EQ(state->utime, flight_.states[80].utime);
  const Eigen::Vector3d error = state->p_G_B - flight_.truth[80];
  EXPECT_LT(error.norm(), 0.6);
  for (int axis = 0; axis < 3; ++axis) {
    EXPECT_LT(std::abs(error(axis)), 3.0 * std::sqrt(state->covariance(axis, axis)) + 0.05) << axis;
  }
  EXPECT_LT(state->q_G_B.angularDistance(flight_.truth_q[80]), 0.005);
  EXPECT_LT((state->v_G_B - truth(80).v_G_B).norm(), 0.4);
}

TEST_F(InertialOnAFlight, ALateStateGivesTheSameAsAPromptOne) {
  Inertial prompt{InertialOptions{}};
  for (size_t k = 0; k < flight_.imu.size() && flight_.imu[k].utime <= flight_.states[60].utime; ++k) {
    prompt.add(flight_.imu[k]);
    if (flight_.imu[k].utime == flight_.states[50].utime) {
      prompt.rebase(truth(50), flight_.states[50].gyro_bias, flight_.states[50].accel_bias);
    }
  }
  add_until(60);
  rebase(50);
  ASSERT_TRUE(inertial_.newest());
  EXPECT_LT((inertial_.newest()->p_G_B - prompt.newest()->p_G_B).norm(), 1e-9);
  EXPECT_LT((inertial_.newest()->covariance - prompt.newest()->covariance).norm(), 1e-9);
}

TEST_F(InertialOnAFlight, SaysNothingBeforeAStateAfterALongGapAndAfterTooLong) {
  add_until(50);
  EXPECT_FALSE(inertial_.newest());
  rebase(50);
  EXPECT_FALSE(inertial_.newest()) << "no sample after the state yet";
  add_until(60);
  EXPECT_TRUE(inertial_.newest());
  EXPECT_FALSE(inertial_.at(flight_.states[70].utime)) << "a second ahead of the samples";
  next_ += 440;  // 2.2 s are lost
  add_until(85);
  EXPECT_FALSE(inertial_.newest());
  rebase(85);
  add_until(90);
  EXPECT_TRUE(inertial_.newest());
  add_until(195);
  EXPECT_FALSE(inertial_.newest()) << "longer than max_time";
}

TEST_F(InertialOnAFlight, RefusesWhatNoSensorMeasures) {
  add_until(50);
  ImuSample bad = flight_.imu[next_];
  bad.specific_force.x() = kUnknown;
  EXPECT_EQ(inertial_.add(bad), Outcome::kBadNumber);
  bad = flight_.imu[next_];
  bad.angular_rate.z() = 1e6;
  EXPECT_EQ(inertial_.add(bad), Outcome::kBadNumber);
  EXPECT_EQ(inertial_.add(flight_.imu[next_ - 1]), Outcome::kOutOfOrder);
  EXPECT_EQ(inertial_.add(flight_.imu[next_]), Outcome::kUsed);
}

TEST_F(InertialOnAFlight, SaysWhereItWasHoweverLateItIsAsked) {
  Inertial prompt{InertialOptions{}};
  const auto rebase_at = [&](Inertial& inertial) {
    inertial.rebase(truth(50), flight_.states[50].gyro_bias, flight_.states[50].accel_bias);
  };
  for (const ImuSample& sample : flight_.imu) {
    if (sample.utime <= flight_.states[60].utime) prompt.add(sample);
  }
  rebase_at(prompt);
  add_until(90);
  rebase_at(inertial_);
  const auto expected = prompt.at(flight_.states[60].utime);
  const auto late = inertial_.at(flight_.states[60].utime);
  ASSERT_TRUE(expected && late);
  EXPECT_EQ(late->utime, flight_.states[60].utime);
  EXPECT_LT((late->p_G_B - expected->p_G_B).norm(), 1e-9);
  EXPECT_LT((late->covariance - expected->covariance).norm(), 1e-9);
  EXPECT_FALSE(inertial_.at(flight_.states[49].utime)) << "before what it goes on from";
}

TEST_F(InertialOnAFlight, ASampleFromTomorrowDoesNotMakeTheTrueOnesLookOld) {
  add_until(50);
  ImuSample tomorrow = flight_.imu[next_];
  tomorrow.utime += 86'400'000'000;
  EXPECT_EQ(inertial_.add(tomorrow), Outcome::kUsed);
  add_until(60);
  rebase(60);
  add_until(70);
  const auto state = inertial_.newest();
  ASSERT_TRUE(state);
  EXPECT_LT((state->p_G_B - flight_.truth[70]).norm(), 0.3);
}

TEST_F(InertialOnAFlight, BridgesAShortGapWithinTheUncertaintyThatItStates) {
  for (size_t from = 20; from <= 140; from += 20) {
    inertial_ = Inertial{InertialOptions{}};
    next_ = static_cast<size_t>(std::find_if(flight_.imu.begin(), flight_.imu.end(),
                                             [&](auto& s) { return s.utime > flight_.states[from - 10].utime; }) -
                                flight_.imu.begin());
    add_until(from);
    rebase(from);
    add_until(from + 5);
    EXPECT_FALSE(inertial_.guessed());
    next_ += 240;  // 1.2 s are lost
    add_until(from + 47);
    const auto state = inertial_.newest();
    ASSERT_TRUE(state);
    EXPECT_TRUE(inertial_.guessed());
    const Eigen::Vector3d error = state->p_G_B - flight_.truth[from + 47];
    EXPECT_LT(error.head<2>().norm(), 3.0 * std::sqrt(state->covariance(0, 0))) << from;
    EXPECT_LT(std::abs(error.z()), 3.0 * std::sqrt(state->covariance(2, 2))) << from;
    EXPECT_GT(state->covariance(0, 0), 9.0) << "3 m at least: nobody knows what was flown";
  }
}

}  // namespace
}  // namespace orthonav::fusion
