// What subscribers make of NAV_STATE that cannot be and of keyframes that come twice.
#include <cstring>
#include <limits>

#include <gtest/gtest.h>

#include "common/bus/keyframe_repeats.h"
#include "common/bus/nav_guard.h"

namespace orthonav {
namespace {

constexpr double kDegreesPerMetre = 1 / 111'320.0;

// `seconds` into a flight to the north at 20 m/s.
nav_state_t flying(double seconds, int32_t resets = 1) {
  nav_state_t state{};
  state.utime = 1'700'000'000'000'000 + static_cast<int64_t>(1e6 * seconds);
  state.mode = nav_state_t::MAP_AIDED;
  state.latitude_deg = 48.5 + 20 * seconds * kDegreesPerMetre;
  state.longitude_deg = 8.5;
  state.ellipsoidal_height = 300;
  state.covariance[0] = state.covariance[7] = state.covariance[14] = 1;
  state.reset_counter = resets;
  return state;
}

nav_state_t moved(nav_state_t state, double north) {
  state.latitude_deg += north * kDegreesPerMetre;
  return state;
}

TEST(NavGuard, BelievesAFlightAndWhatFixesCorrect) {
  NavGuard guard;
  for (int i = 0; i < 1000; ++i) EXPECT_EQ(guard.refusal(flying(0.005 * i)), nullptr);
  EXPECT_EQ(guard.refusal(moved(flying(5.1), 40)), nullptr);
}

TEST(NavGuard, RefusesJumpsThatNoResetExplains) {
  NavGuard guard;
  EXPECT_EQ(guard.refusal(flying(0)), nullptr);
  for (int i = 1; i < 100; ++i) {
    EXPECT_STREQ(guard.refusal(moved(flying(0.01 * i), 100e3)), "jump");
    EXPECT_STREQ(guard.refusal(moved(flying(0.01 * i, 0), 100e3)), "jump");
    EXPECT_EQ(guard.refusal(flying(0.01 * i)), nullptr);
  }
  EXPECT_EQ(guard.refusal(moved(flying(1, 2), 100e3)), nullptr) << "the position was moved, and the counter says so";
}

TEST(NavGuard, BelievesAnyPlaceAfterASilence) {
  NavGuard guard;
  EXPECT_EQ(guard.refusal(flying(0)), nullptr);
  EXPECT_EQ(guard.refusal(moved(flying(2.5), 100e3)), nullptr);
}

TEST(NavGuard, AnUncertainPositionMayMoveFurther) {
  NavGuard guard;
  nav_state_t coasting = flying(0);
  coasting.covariance[0] = coasting.covariance[7] = 100 * 100;
  EXPECT_EQ(guard.refusal(coasting), nullptr);
  EXPECT_EQ(guard.refusal(moved(flying(0.1), 400)), nullptr);
  // But whoever claims to know nothing does not make any place believable.
  nav_state_t forged = moved(flying(0.2), 400);
  forged.covariance[0] = forged.covariance[7] = 1e12;
  EXPECT_EQ(guard.refusal(forged), nullptr);
  EXPECT_STREQ(guard.refusal(moved(flying(0.3), 100e3)), "jump");
}

TEST(NavGuard, RefusesWhatNoAircraftIs) {
  NavGuard guard;
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const auto refused = [&](auto change) {
    nav_state_t state = flying(0);
    change(state);
    const char* why = guard.refusal(state);
    return why != nullptr && std::strcmp(why, "implausible") == 0;
  };
  EXPECT_TRUE(refused([](nav_state_t& s) { s.latitude_deg = 91; }));
  EXPECT_TRUE(refused([](nav_state_t& s) { s.longitude_deg = 1e300; }));
  EXPECT_TRUE(refused([&](nav_state_t& s) { s.longitude_deg = nan; }));
  EXPECT_TRUE(refused([&](nav_state_t& s) { s.ellipsoidal_height = nan; }));
  EXPECT_TRUE(refused([&](nav_state_t& s) { s.covariance[7] = nan; }));
  EXPECT_TRUE(refused([](nav_state_t& s) { s.covariance[0] = -1; }));
  EXPECT_FALSE(refused([&](nav_state_t& s) { s.latitude_deg = nan; })) << "no position yet";
  EXPECT_FALSE(refused([](nav_state_t& s) { s.utime = std::numeric_limits<int64_t>::min(); }));
  EXPECT_FALSE(refused([](nav_state_t& s) { s.utime = std::numeric_limits<int64_t>::max(); }));
}

TEST(NavGuard, FliesOverTheDateLine) {
  NavGuard guard;
  nav_state_t state = flying(0);
  state.longitude_deg = 179.99999;
  EXPECT_EQ(guard.refusal(state), nullptr);
  state.longitude_deg = -179.99999;
  EXPECT_EQ(guard.refusal(state), nullptr);
}

TEST(KeyframeRepeats, KnowsThoseOfTheLastEightAndNoOther) {
  KeyframeRepeats repeats;
  vio_keyframe_t keyframe{};
  for (int id = 0; id < 20; ++id) {
    keyframe.utime = 1'000'000 + id;
    keyframe.session = 7;
    keyframe.id = id;
    EXPECT_FALSE(repeats.add(keyframe));
    EXPECT_TRUE(repeats.add(keyframe));
    // A forged one that only has the number does not hide the next.
    vio_keyframe_t forged = keyframe;
    forged.utime = 5;
    forged.id = id + 1;
    EXPECT_FALSE(repeats.add(forged));
  }
}

}  // namespace
}  // namespace orthonav
