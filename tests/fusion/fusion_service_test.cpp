// The service on a bus: what it answers to good and bad messages.
#include "services/fusion/fusion_service.h"

#include <algorithm>
#include <limits>
#include <optional>
#include <vector>

#include <gtest/gtest.h>

#include "common/bus/channels.h"
#include "orthonav/nav_state_t.hpp"
#include "tests/faults/vandal.h"
#include "tests/fusion/synthetic_flight.h"
#include "tests/support/temporary_folder.h"

namespace orthonav::fusion {
namespace {

void put(const Eigen::Vector3d& v, double (&out)[3]) {
  for (int k = 0; k < 3; ++k) out[k] = v(k);
}
void put(const Eigen::Quaterniond& q, double (&out)[4]) {
  const double wxyz[4] = {q.w(), q.x(), q.y(), q.z()};
  for (int k = 0; k < 4; ++k) out[k] = wxyz[k];
}

class FusionOnABus : public ::testing::Test {
 protected:
  void send(const OdometryState& state) {
    vio_state_t message{};
    message.utime = state.utime;
    message.session = state.session;
    message.status = vio_state_t::TRACKING;
    put(state.p_W_B, message.p_W_B);
    put(state.q_W_B, message.q_W_B);
    Eigen::Map<Eigen::Vector2d>{message.levelled} = state.levelled;
    for (const int k : {3, 4}) message.pose_covariance[7 * k] = state.lean_stddev * state.lean_stddev;
    put(state.v_W_B, message.v_W_B);
    message.height_above_ground = 109.0;
    message.num_tracked = state.has_tracks ? 100 : 0;
    publish(channel::kVioState, message);
  }
  void send(const Keyframe& keyframe) {
    vio_keyframe_t message{};
    message.utime = keyframe.utime;
    message.session = keyframe.session;
    message.id = keyframe.id;
    put(keyframe.p_W_B, message.p_W_B);
    put(keyframe.q_W_B, message.q_W_B);
    Eigen::Map<Eigen::Vector2d>{message.levelled} = keyframe.levelled;
    message.height_above_ground = keyframe.height_above_ground;
    for (double& value : message.relative_covariance) value = std::numeric_limits<double>::quiet_NaN();
    publish(channel::kVioKeyframe, message);
  }
  void send(const ImuSample& sample) {
    imu_t message{};
    message.utime = sample.utime;
    put(sample.angular_rate, message.angular_rate);
    put(sample.specific_force, message.specific_force);
    publish(channel::kImu, message);
  }
  static map_fix_t message_of(const Fix& fix) {
    map_fix_t message{};
    message.utime = fix.utime;
    message.session = fix.session;
    message.keyframe_id = fix.keyframe_id;
    message.valid = true;
    message.latitude_deg = fix.position.latitude_deg;
    message.longitude_deg = fix.position.longitude_deg;
    message.ellipsoidal_height = fix.position.height;
    message.anchor_latitude_deg = fix.anchor.latitude_deg;
    message.anchor_longitude_deg = fix.anchor.longitude_deg;
    message.anchor_height = fix.anchor.height;
    for (int k = 0; k < 3; ++k) message.position_covariance[4 * k] = fix.covariance(k, k);
    for (double& value : message.q_G_B) value = std::numeric_limits<double>::quiet_NaN();
    message.heading = fix.heading;
    message.heading_stddev = fix.heading_stddev;
    message.heading_correction = message.scale = message.log_odds = std::numeric_limits<double>::quiet_NaN();
    message.num_keyframes = 1;
    return message;
  }
  template <class Msg>
  void publish(const char* channel, const Msg& message) {
    bus_.publish(channel, &message);
    while (bus_.handleTimeout(0) > 0) {
    }
  }
  void fly(size_t from, size_t to) {
    for (size_t k = from; k < to; ++k) {
      const SyntheticFlight::Step& step = flight_.steps[k];
      if (step.kind == SyntheticFlight::Step::Kind::kState) send(flight_.states[step.index]);
      if (step.kind == SyntheticFlight::Step::Kind::kKeyframe) send(flight_.keyframes[step.index]);
      if (step.kind == SyntheticFlight::Step::Kind::kFix) {
        publish(channel::kMapFix, message_of(flight_.fixes[step.index]));
      }
      if (step.kind == SyntheticFlight::Step::Kind::kImu) send(flight_.imu[step.index]);
    }
  }

  struct Listener {
    std::vector<nav_state_t> states;
    void receive(const lcm::ReceiveBuffer*, const std::string&, const nav_state_t* m) {
      if (m->processing_ms != faults::kForged) states.push_back(*m);
    }
  };

  SyntheticFlight flight_ = make_flight({.duration = 20.0, .single_wrong_rate = 0.0}, 1);
  lcm::LCM bus_{"memq://"};
  Listener heard_;
  lcm::Subscription* subscription_ = bus_.subscribe(channel::kNavState, &Listener::receive, &heard_);
  std::optional<Node> node_{std::in_place, NodeOptions{.service = "fusion"}, bus_};
  std::optional<FusionService> service_{std::in_place, *node_, std::filesystem::path(ORTHONAV_SOURCE) / "config/quick"};
};

TEST_F(FusionOnABus, AnswersEveryOdometryStateAndFindsItsPlace) {
  fly(0, flight_.steps.size());
  ASSERT_EQ(heard_.states.size(), flight_.states.size());
  EXPECT_EQ(heard_.states.front().mode, +nav_state_t::DEAD_RECKONING);
  EXPECT_TRUE(std::isnan(heard_.states.front().latitude_deg));
  const nav_state_t& last = heard_.states.back();
  EXPECT_EQ(last.utime, flight_.states.back().utime);
  EXPECT_EQ(last.mode, +nav_state_t::MAP_AIDED);
  EXPECT_EQ(last.height_above_ground, 109.0);
  EXPECT_EQ(last.processing_ms, 0.0) << "a replay repeats bit for bit";
  const EnuFrame frame(flight_.anchor);
  const Eigen::Vector3d p = frame.to_enu({last.latitude_deg, last.longitude_deg, last.ellipsoidal_height});
  EXPECT_LT((p - flight_.truth.back()).norm(), 8.0);
  EXPECT_EQ(node_->health().state(), Health::State::kOk);
  EXPECT_EQ(node_->health().counter("states.received"), static_cast<double>(flight_.states.size()));
}

TEST_F(FusionOnABus, TakesAFixApartAsItsMessageSays) {
  // All fixes are put halfway upright, and say what they were, how they move and what they see of the lean: what
  // is written here by its place in the message, row by row.
  SyntheticOptions options{.duration = 40.0, .height = 285.0, .single_wrong_rate = 0.0};
  options.lean = Eigen::Vector2d(0.03, -0.01);
  options.lean_word = 0.02;
  options.perspective_stddev = 0.002;
  options.fix_stddev = options.fix_vertical_stddev = 1.0;
  flight_ = make_flight(options, 1);
  const EnuFrame frame(flight_.anchor);
  for (const SyntheticFlight::Step& step : flight_.steps) {
    if (step.kind == SyntheticFlight::Step::Kind::kState) send(flight_.states[step.index]);
    if (step.kind == SyntheticFlight::Step::Kind::kKeyframe) send(flight_.keyframes[step.index]);
    if (step.kind != SyntheticFlight::Step::Kind::kFix) continue;
    const Fix& fix = flight_.fixes[step.index];
    const Eigen::Vector3d upright = frame.to_enu(fix.position);
    const double height = upright.z();
    const Eigen::Vector2d tilt = fix.upright->tilt;
    const Eigen::Vector3d halfway = upright - 0.5 * Eigen::Vector3d(-height * tilt.y(), height * tilt.x(), 0.0);
    const Geodetic position = frame.to_geodetic(halfway);
    map_fix_t message = message_of(fix);
    message.latitude_deg = position.latitude_deg;
    message.longitude_deg = position.longitude_deg;
    message.ellipsoidal_height = position.height;
    put(halfway, message.p_G_B);
    put(upright, message.upright_p_G_B);
    for (int k = 0; k < 3; ++k) message.upright_covariance[4 * k] = 1.0;
    message.upright_lever[1] = -height;  // east by a turn about north
    message.upright_lever[2] = height;   // north by a turn about east
    message.tilt[0] = tilt.x();
    message.tilt[1] = tilt.y();
    message.tilt_covariance[0] = message.tilt_covariance[3] = 4e-6;
    publish(channel::kMapFix, message);
  }
  const nav_state_t& last = heard_.states.back();
  const Eigen::Vector3d p = frame.to_enu({last.latitude_deg, last.longitude_deg, last.ellipsoidal_height});
  EXPECT_LT((p - flight_.truth.back()).head<2>().norm(), 2.5) << "9 m off where nobody is put upright";
  const Eigen::Quaterniond q(last.q_G_B[0], last.q_G_B[1], last.q_G_B[2], last.q_G_B[3]);
  const Eigen::Vector3d up = q * (flight_.truth_q.back().conjugate() * Eigen::Vector3d::UnitZ());
  EXPECT_LT(up.head<2>().norm(), 0.004) << "1.8 degrees of lean";
}

TEST_F(FusionOnABus, CountsWhatItRefusesAndGoesOn) {
  const size_t half = flight_.steps.size() / 2;
  fly(0, half);
  map_fix_t fix = message_of(flight_.fixes.front());
  fix.keyframe_id = 12345;
  publish(channel::kMapFix, fix);
  EXPECT_EQ(node_->health().counter("rejected.fix.unknown_keyframe"), 1.0);
  fix = message_of(flight_.fixes.back());
  fix.latitude_deg = std::numeric_limits<double>::quiet_NaN();
  publish(channel::kMapFix, fix);
  EXPECT_EQ(node_->health().counter("rejected.fix.bad_number"), 1.0);
  fix.valid = false;
  publish(channel::kMapFix, fix);
  EXPECT_EQ(node_->health().counter("fixes.invalid"), 1.0);
  OdometryState state = flight_.states[50];
  state.p_W_B.x() = std::numeric_limits<double>::infinity();
  send(state);
  EXPECT_EQ(node_->health().counter("rejected.state.bad_number"), 1.0);
  EXPECT_EQ(heard_.states.back().mode, +nav_state_t::WAITING_FOR_VIO) << "a state without a pose is still answered";
  fly(half, flight_.steps.size());
  EXPECT_EQ(heard_.states.back().mode, +nav_state_t::MAP_AIDED);
}

TEST_F(FusionOnABus, AFloodOfAbsurdMessagesMovesNothingAndIsNotAnswered) {
  flight_ = make_flight({.duration = 30.0, .single_wrong_rate = 0.0, .imu = true}, 1);
  const size_t third = flight_.steps.size() / 3;
  fly(0, third);
  ASSERT_EQ(heard_.states.back().mode, +nav_state_t::MAP_AIDED);
  const size_t before = heard_.states.size();
  std::mt19937_64 random(1);
  for (size_t k = third; k < 2 * third; ++k) {
    fly(k, k + 1);
    // Twenty for each true one of any kind, a thousand for each state of the odometry.
    for (int i = 0; i < 20; ++i) {
      faults::publish_absurd(bus_, random, heard_.states.back().utime, heard_.states.back().session, 10);
    }
    while (bus_.handleTimeout(0) > 0) {
    }
  }
  fly(2 * third, flight_.steps.size());
  const EnuFrame frame(flight_.anchor);
  for (size_t k = before; k < heard_.states.size(); ++k) {
    const nav_state_t& state = heard_.states[k];
    ASSERT_EQ(state.mode, +nav_state_t::MAP_AIDED) << "answer " << k - before;
    ASSERT_EQ(state.reset_counter, 1);
  }
  const nav_state_t& last = heard_.states.back();
  const Eigen::Vector3d p = frame.to_enu({last.latitude_deg, last.longitude_deg, last.ellipsoidal_height});
  EXPECT_LT((p - flight_.truth.back()).norm(), 8.0);
}

TEST_F(FusionOnABus, SaysThatThePositionIsLostWhenNothingCarriesItOn) {
  flight_ = make_flight({.duration = 20.0, .single_wrong_rate = 0.0, .imu = true}, 1);
  const size_t half = flight_.steps.size() / 2;
  fly(0, half);
  ASSERT_EQ(heard_.states.back().mode, +nav_state_t::MAP_AIDED);
  const nav_state_t last = heard_.states.back();
  const size_t before = heard_.states.size();
  const auto pass = [&](int64_t from, int64_t to) {
    for (int64_t t = from; t <= to; t += 100'000) node_->advance(last.utime + t);
    while (bus_.handleTimeout(0) > 0) {
    }
  };
  pass(0, 2'000'000);
  EXPECT_EQ(heard_.states.size(), before) << "a pause is no loss";
  pass(2'100'000, 10'000'000);
  ASSERT_GT(heard_.states.size(), before + 5) << "and it is said again";
  for (size_t k = before; k < heard_.states.size(); ++k) {
    const nav_state_t& lost = heard_.states[k];
    EXPECT_EQ(lost.mode, +nav_state_t::LOST);
    EXPECT_TRUE(std::isnan(lost.latitude_deg) && std::isnan(lost.covariance[0]) && std::isnan(lost.p_G_B[0]));
    EXPECT_TRUE(std::isnan(lost.height_above_ground));
    EXPECT_EQ(lost.reset_counter, last.reset_counter);
    EXPECT_GT(lost.utime, heard_.states[k - 1].utime);
  }
  EXPECT_NEAR(1e-6 * static_cast<double>(heard_.states.back().utime - last.utime), 10, 1.1);
  EXPECT_EQ(node_->health().state(), Health::State::kFailed);
  fly(half, flight_.steps.size());
  EXPECT_EQ(heard_.states.back().mode, +nav_state_t::MAP_AIDED);
  EXPECT_EQ(node_->health().state(), Health::State::kOk);
}

TEST_F(FusionOnABus, SaysThatThePositionIsLostAlsoWhenItsLastAnswerHadNone) {
  fly(0, flight_.steps.size() / 2);
  ASSERT_EQ(heard_.states.back().mode, +nav_state_t::MAP_AIDED);
  vio_state_t begins_anew{};
  begins_anew.utime = heard_.states.back().utime + 100'000;
  begins_anew.session = heard_.states.back().session + 1;
  begins_anew.status = vio_state_t::INITIALISING;
  publish(channel::kVioState, begins_anew);
  ASSERT_TRUE(std::isnan(heard_.states.back().latitude_deg));
  for (int64_t t = 0; t <= 5'000'000; t += 100'000) node_->advance(begins_anew.utime + t);
  while (bus_.handleTimeout(0) > 0) {
  }
  EXPECT_EQ(heard_.states.back().mode, +nav_state_t::LOST);
  EXPECT_GT(heard_.states.back().utime, begins_anew.utime + 2'500'000);
}

TEST_F(FusionOnABus, AnotherServiceGoesOnFromItsMemory) {
  const test::TemporaryFolder folder;
  const auto config = std::filesystem::path(ORTHONAV_SOURCE) / "config/quick";
  service_.reset();
  node_.reset();
  const size_t half = flight_.steps.size() / 2;
  {
    Node node({.service = "fusion"}, bus_);
    FusionService service(node, config, folder / "memory");
    fly(0, half);
  }
  ASSERT_EQ(heard_.states.back().mode, +nav_state_t::MAP_AIDED);
  const nav_state_t last = heard_.states.back();
  Node node({.service = "fusion"}, bus_);
  FusionService service(node, config, folder / "memory");
  EXPECT_EQ(node.health().counter("memory.read"), 1.0);
  fly(half, flight_.steps.size());
  const nav_state_t& first = heard_.states[static_cast<size_t>(
      std::find_if(heard_.states.begin(), heard_.states.end(), [&](auto& s) { return s.utime > last.utime; }) -
      heard_.states.begin())];
  EXPECT_EQ(first.mode, +nav_state_t::COASTING);
  EXPECT_LT((Eigen::Vector3d(first.p_G_B) - Eigen::Vector3d(last.p_G_B)).norm(), 1.0);
  EXPECT_EQ(heard_.states.back().mode, +nav_state_t::MAP_AIDED);
  EXPECT_EQ(heard_.states.back().reset_counter, last.reset_counter);
}

}  // namespace
}  // namespace orthonav::fusion
