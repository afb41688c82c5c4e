// The service on a bus: what it answers to good and bad messages.
#include "services/fusion/fusion_service.h"

#include <limits>
#include <vector>

#include <gtest/gtest.h>

#include "common/bus/channels.h"
#include "orthonav/nav_state_t.hpp"
#include "tests/fusion/synthetic_flight.h"

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
    put(state.v_W_B, message.v_W_B);
    message.height_above_ground = 109.0;
    publish(channel::kVioState, message);
  }
  void send(const Keyframe& keyframe) {
    vio_keyframe_t message{};
    message.utime = keyframe.utime;
    message.session = keyframe.session;
    message.id = keyframe.id;
    put(keyframe.p_W_B, message.p_W_B);
    put(keyframe.q_W_B, message.q_W_B);
    message.height_above_ground = keyframe.height_above_ground;
    for (double& value : message.relative_covariance) value = std::numeric_limits<double>::quiet_NaN();
    publish(channel::kVioKeyframe, message);
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
    message.heading_correction = message.scale = std::numeric_limits<double>::quiet_NaN();
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
    }
  }

  struct Listener {
    std::vector<nav_state_t> states;
    void receive(const lcm::ReceiveBuffer*, const std::string&, const nav_state_t* m) { states.push_back(*m); }
  };

  SyntheticFlight flight_ = make_flight({.duration = 20.0, .single_wrong_rate = 0.0}, 1);
  lcm::LCM bus_{"memq://"};
  Listener heard_;
  lcm::Subscription* subscription_ = bus_.subscribe(channel::kNavState, &Listener::receive, &heard_);
  Node node_{{.service = "fusion"}, bus_};
  FusionService service_{node_, std::filesystem::path(ORTHONAV_SOURCE) / "config/quick"};
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
  EXPECT_EQ(node_.health().state(), Health::State::kOk);
  EXPECT_EQ(node_.health().counter("states.received"), static_cast<double>(flight_.states.size()));
}

TEST_F(FusionOnABus, CountsWhatItRefusesAndGoesOn) {
  const size_t half = flight_.steps.size() / 2;
  fly(0, half);
  map_fix_t fix = message_of(flight_.fixes.front());
  fix.keyframe_id = 12345;
  publish(channel::kMapFix, fix);
  EXPECT_EQ(node_.health().counter("rejected.fix.unknown_keyframe"), 1.0);
  fix = message_of(flight_.fixes.back());
  fix.latitude_deg = std::numeric_limits<double>::quiet_NaN();
  publish(channel::kMapFix, fix);
  EXPECT_EQ(node_.health().counter("rejected.fix.bad_number"), 1.0);
  fix.valid = false;
  publish(channel::kMapFix, fix);
  EXPECT_EQ(node_.health().counter("fixes.invalid"), 1.0);
  OdometryState state = flight_.states[50];
  state.p_W_B.x() = std::numeric_limits<double>::infinity();
  send(state);
  EXPECT_EQ(node_.health().counter("rejected.state.bad_number"), 1.0);
  EXPECT_EQ(heard_.states.back().mode, +nav_state_t::WAITING_FOR_VIO) << "a state without a pose is still answered";
  fly(half, flight_.steps.size());
  EXPECT_EQ(heard_.states.back().mode, +nav_state_t::MAP_AIDED);
}

}  // namespace
}  // namespace orthonav::fusion
