#include "common/bus/node.h"

#include <algorithm>
#include <atomic>
#include <cctype>
#include <semaphore>
#include <thread>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "common/bus/channels.h"
#include "orthonav/compass_t.hpp"
#include "orthonav/image_t.hpp"
#include "orthonav/imu_t.hpp"
#include "orthonav/vio_keyframe_t.hpp"
#include "orthonav/vio_reset_t.hpp"
#include "tests/support/bus_client.h"

namespace orthonav {
namespace {

using test::Collector;
using test::handle_until;

imu_t imu_at(int64_t utime) {
  imu_t imu{};
  imu.utime = utime;
  return imu;
}

// ---- decoders ------------------------------------------------------------------------------------------------------

template <class Msg>
std::vector<uint8_t> encoded(const Msg& message) {
  std::vector<uint8_t> bytes(static_cast<size_t>(message.getEncodedSize()));
  message.encode(bytes.data(), 0, static_cast<int>(bytes.size()));
  return bytes;
}

template <class Msg>
bool decodes(const std::vector<uint8_t>& bytes, Msg& message) {
  return message.decode(bytes.data(), 0, static_cast<int>(bytes.size())) >= 0;
}

TEST(Decoders, BelieveNoLengthThatTheMessageHasNoBytesFor) {
  const vio_keyframe_t none{};
  auto bytes = encoded(none);
  vio_keyframe_t keyframe{};
  ASSERT_TRUE(decodes(bytes, keyframe));
  uint8_t* num_features = bytes.data() + bytes.size() - 12;  // followed by scale_stddev
  for (const int count : {-1, 9, 1 << 30}) {
    for (int k = 0; k < 4; ++k) num_features[k] = static_cast<uint8_t>(static_cast<uint32_t>(count) >> (24 - 8 * k));
    keyframe = {};
    EXPECT_FALSE(decodes(bytes, keyframe)) << count;
    EXPECT_EQ(keyframe.features.capacity(), 0u) << count;
  }
}

TEST(Decoders, RefuseAStringOfNegativeLength) {
  const map_tile_t empty{};
  auto bytes = encoded(empty);
  map_tile_t tile{};
  ASSERT_TRUE(decodes(bytes, tile));
  for (int k = 16; k < 20; ++k) bytes[static_cast<size_t>(k)] = 0xff;  // of the fingerprint, behind hash and utime
  EXPECT_FALSE(decodes(bytes, tile));
}

// ---- replayed -------------------------------------------------------------------------------------------------------

class ReplayedNode : public testing::Test {
 protected:
  void pump() {
    while (bus_.handleTimeout(0) > 0) {
    }
  }
  lcm::LCM bus_{"memq://"};
};

TEST_F(ReplayedNode, DeliversInTheOrderOfPublication) {
  Node sender({.service = "a"}, bus_), receiver({.service = "b"}, bus_);
  std::vector<int64_t> seen;
  receiver.subscribe<imu_t>("IMU", Delivery::kAll, [&](const imu_t& m) { seen.push_back(m.utime); });
  receiver.subscribe<compass_t>("COMPASS", Delivery::kLatest, [&](const compass_t& m) { seen.push_back(-m.utime); });
  for (int i = 1; i <= 100; ++i) {
    sender.publish("IMU", imu_at(i));
    compass_t compass{};
    compass.utime = i;
    sender.publish("COMPASS", compass);
  }
  pump();
  ASSERT_EQ(seen.size(), 200u);
  for (int i = 0; i < 100; ++i) {
    EXPECT_EQ(seen[static_cast<size_t>(2 * i)], i + 1);
    EXPECT_EQ(seen[static_cast<size_t>(2 * i) + 1], -(i + 1));
  }
}

TEST_F(ReplayedNode, TimersFollowTheTimeOfTheData) {
  Node node({.service = "a"}, bus_);
  std::vector<int64_t> fired;
  node.every(std::chrono::milliseconds(10), [&] { fired.push_back(node.now()); });
  for (int64_t t = 1'000'000; t <= 1'100'000; t += 5'000) node.advance(t);
  EXPECT_EQ(fired.size(), 10u);
  EXPECT_EQ(node.now(), 1'100'000);
  // A day without data is not made up for by millions of calls.
  node.advance(86'400'000'000);
  EXPECT_LE(fired.size(), 12u);
}

TEST_F(ReplayedNode, UndecodableMessagesAreCountedAndSurvived) {
  Node node({.service = "a"}, bus_);
  int handled = 0;
  node.subscribe<imu_t>("IMU", Delivery::kAll, [&](const imu_t&) { ++handled; });
  node.health().set_state(Health::State::kOk);
  const std::string garbage = "not a message of any kind";
  bus_.publish("IMU", garbage.data(), static_cast<unsigned>(garbage.size()));
  bus_.publish("IMU", garbage.data(), 0u);
  Node({.service = "b"}, bus_).publish("IMU", imu_at(5));
  pump();
  EXPECT_EQ(handled, 1);
  EXPECT_EQ(node.health().counter("rejected.undecodable.IMU"), 2);
}

TEST_F(ReplayedNode, AHandlerThatThrowsIsCountedAndSurvived) {
  Node node({.service = "a"}, bus_);
  node.subscribe<imu_t>("IMU", Delivery::kAll, [&](const imu_t& m) {
    if (m.utime == 1) throw std::runtime_error("no good");
  });
  node.publish("IMU", imu_at(1));
  node.publish("IMU", imu_at(2));
  pump();
  EXPECT_EQ(node.health().counter("rejected.exception.IMU"), 1);
  EXPECT_EQ(node.health().counter("received.IMU"), 2);
}

TEST_F(ReplayedNode, RequestsForAResetAreHeardHowFarApartTheyAre) {
  Node node({.service = "vio"}, bus_);
  int heard = 0;
  node.subscribe<vio_reset_t>(channel::kVioReset, Delivery::kAll, [&](const vio_reset_t&) { ++heard; });
  for (const int64_t utime : {int64_t{1'000'000}, int64_t{3'600'000'000}, int64_t{7'000'000}, int64_t{0}}) {
    vio_reset_t request{};
    request.utime = utime;
    node.publish(channel::kVioReset, request);
  }
  pump();
  EXPECT_EQ(heard, 4);
}

TEST_F(ReplayedNode, HeartbeatShowsStateCountersAndTheLastReject) {
  Node node({.service = "vio"}, bus_);
  Collector<health_t> heartbeats(bus_, channel::kHealth);
  node.health().set_state(Health::State::kOk);
  node.advance(1'000'000);
  node.health().reject("camera.corrupt", "CAMERA at 7: no JPEG");
  node.advance(2'000'000);
  node.advance(9'000'000);
  pump();
  ASSERT_GE(heartbeats.messages.size(), 2u);
  const health_t& during = heartbeats.messages.front();
  EXPECT_EQ(during.service, "vio");
  EXPECT_EQ(during.state, +health_t::DEGRADED);
  EXPECT_EQ(during.message, "CAMERA at 7: no JPEG");
  ASSERT_EQ(during.counters.size(), 1u);
  EXPECT_EQ(during.counters[0].name, "rejected.camera.corrupt");
  EXPECT_EQ(heartbeats.messages.back().state, +health_t::OK) << "a reject degrades for a few seconds, not for ever";
}

TEST_F(ReplayedNode, StopwatchReadsZeroSoThatAReplayRepeats) {
  Node node({.service = "a"}, bus_);
  const Stopwatch watch(node);
  std::this_thread::sleep_for(std::chrono::milliseconds(2));
  EXPECT_EQ(watch.ms(), 0.0);
}

// ---- live, over UDP multicast ---------------------------------------------------------------------------------------

class LiveNode : public testing::Test {
 protected:
  void SetUp() override { node_ = std::make_unique<Node>(NodeOptions{.service = "live"}); }
  void start() {
    thread_ = std::thread([this] { node_->run(); });
  }
  void TearDown() override {
    node_->stop();
    if (thread_.joinable()) thread_.join();
  }
  std::unique_ptr<Node> node_;
  std::thread thread_;
  lcm::LCM bus_;
};

TEST_F(LiveNode, EchoesAcrossTheBusAndSendsAHeartbeatAtOnce) {
  ASSERT_TRUE(bus_.good());
  node_->subscribe<imu_t>("IMU", Delivery::kAll, [this](const imu_t& m) { node_->publish("ECHO", m); });
  Collector<imu_t> echo(bus_, "ECHO");
  Collector<health_t> heartbeats(bus_, channel::kHealth);
  start();
  ASSERT_TRUE(handle_until(bus_, [&] { return !heartbeats.messages.empty(); }));
  EXPECT_EQ(heartbeats.messages[0].service, "live");
  EXPECT_GT(heartbeats.messages[0].pid, 0);
  const imu_t imu = imu_at(42);
  bus_.publish("IMU", &imu);
  ASSERT_TRUE(handle_until(bus_, [&] { return !echo.messages.empty(); }));
  EXPECT_EQ(echo.messages[0].utime, 42);
}

// The handler of the first message holds the node up until all others have arrived, as a slow service does.
TEST_F(LiveNode, KeepsEveryInertialSampleTheLatestImagesAndTheNewestState) {
  constexpr int kImages = 10, kSamples = 5;
  int imu_count = 0;
  std::vector<int64_t> images, states;
  std::binary_semaphore go{0};
  node_->subscribe<compass_t>("HOLD", Delivery::kAll,
                              [&](const compass_t&) { EXPECT_TRUE(go.try_acquire_for(test::kPatience)); });
  node_->subscribe<imu_t>("IMU", Delivery::kAll, [&](const imu_t&) { ++imu_count; });
  node_->subscribe<image_t>(
      "CAMERA", Delivery::kLatest, [&](const image_t& m) { images.push_back(m.utime); }, 2);
  node_->subscribe<compass_t>("STATE", Delivery::kReplace, [&](const compass_t& m) { states.push_back(m.utime); });
  node_->subscribe<compass_t>("DONE", Delivery::kAll, [&](const compass_t& m) { node_->publish("REPORT", m); });
  // Through a second node: it hears everything that the first one hears.
  Collector<compass_t> done(bus_, "DONE"), report(bus_, "REPORT");
  Collector<health_t> heartbeats(bus_, channel::kHealth);
  start();
  const compass_t mark{};
  compass_t state{};
  image_t image{};
  image.data.resize(1000);
  image.size = 1000;
  // Once, unless the node's receiving thread sleeps so long that nothing waits when the node is let go.
  int sent = 0;
  for (size_t round = 1; round <= 100 && static_cast<int>(images.size()) == sent; ++round) {
    bus_.publish("HOLD", &mark);
    // All of it fits into the kernel's default receive buffer: however late that thread wakes, nothing is lost.
    for (int i = 0; i < kImages; ++i) {
      for (int k = 0; k < kSamples; ++k) {
        const imu_t imu = imu_at(kSamples * sent + k);
        bus_.publish("IMU", &imu);
      }
      state.utime = image.utime = ++sent;
      bus_.publish("CAMERA", &image);
      bus_.publish("STATE", &state);
    }
    bus_.publish("DONE", &mark);
    ASSERT_TRUE(handle_until(bus_, [&] { return done.messages.size() == round; }));
    go.release();
    ASSERT_TRUE(handle_until(bus_, [&] { return report.messages.size() == round; }));
  }
  const size_t before = heartbeats.messages.size();
  ASSERT_TRUE(handle_until(bus_, [&] { return heartbeats.messages.size() >= before + 2; }));
  node_->stop();
  thread_.join();
  EXPECT_EQ(imu_count, kSamples * sent);
  EXPECT_LT(images.size(), static_cast<size_t>(sent));
  EXPECT_EQ(images.back(), sent);
  EXPECT_EQ(static_cast<double>(images.size()) + node_->health().counter("rejected.overrun.CAMERA"), sent);
  // A state that was replaced is no loss.
  EXPECT_LT(states.size(), static_cast<size_t>(sent));
  EXPECT_EQ(states.back(), sent);
  EXPECT_EQ(node_->health().counter("rejected.overrun.STATE"), 0);
}

TEST_F(LiveNode, AClampedReceiveBufferIsSaidInTheHealthWithTheRemedy) {
  node_ = std::make_unique<Node>(NodeOptions{.service = "live", .receive_buffer = 1 << 30});
  Collector<health_t> heartbeats(bus_, channel::kHealth);
  node_->health().set_state(Health::State::kOk);
  start();
  ASSERT_TRUE(handle_until(bus_, [&] { return !heartbeats.messages.empty(); }));
  EXPECT_EQ(heartbeats.messages.back().state, +health_t::DEGRADED);
  EXPECT_THAT(heartbeats.messages.back().message, testing::HasSubstr("net.core.rmem_max"));
}

TEST_F(LiveNode, AnotherProcessOfTheSameNameThatPublishesIsSaidInTheHealth) {
  node_ = std::make_unique<Node>(NodeOptions{.service = "live", .receive_buffer = 1 << 16});
  node_->health().set_state(Health::State::kOk);
  Collector<health_t> heartbeats(bus_, channel::kHealth);
  start();
  health_t twin{};
  twin.service = "live";
  twin.host = "elsewhere";
  twin.pid = 7;
  twin.utime = node_->now();
  const auto says_so = [&](size_t after) {
    return std::any_of(heartbeats.messages.begin() + static_cast<std::ptrdiff_t>(after), heartbeats.messages.end(),
                       [](const health_t& m) {
                         return m.host != "elsewhere" && m.state == +health_t::DEGRADED &&
                                m.message.find("process 7 on elsewhere") != std::string::npos;
                       });
  };
  // One that only listens is no harm. Two heartbeats later it has been heard.
  bus_.publish(channel::kHealth, &twin);
  ASSERT_TRUE(handle_until(bus_, [&] { return heartbeats.messages.size() >= 4; }));
  EXPECT_FALSE(says_so(0));
  health_counter_t published;
  published.name = "published.ECHO";
  twin.counters = {published};
  twin.num_counters = 1;
  const size_t before = heartbeats.messages.size();
  twin.utime = node_->now();
  bus_.publish(channel::kHealth, &twin);
  EXPECT_TRUE(handle_until(bus_, [&] { return says_so(before); }));
  const auto is_well = [&] {
    return heartbeats.messages.back().host != "elsewhere" && heartbeats.messages.back().state == +health_t::OK;
  };
  EXPECT_TRUE(handle_until(bus_, is_well)) << "it is gone";
}

TEST_F(LiveNode, AChannelThatIsExpectedAndFallsSilentIsSaidWhateverTheServiceSays) {
  for (const char* channel : {"IMU", "CAMERA", "COMPASS"}) {
    node_->subscribe<imu_t>(channel, Delivery::kAll, [](const imu_t&) {});
  }
  node_->expect("IMU");
  node_->expect("COMPASS");
  node_->health().set_state(Health::State::kOk);
  Collector<health_t> heartbeats(bus_, channel::kHealth);
  start();
  // One that never came is the service's to wait for.
  const imu_t imu = imu_at(1);
  bus_.publish("IMU", &imu);
  bus_.publish("CAMERA", &imu);
  const auto sent = std::chrono::steady_clock::now();
  const auto silent = [&](const std::string& of) {
    const health_t& last = heartbeats.messages.back();
    return last.state == +health_t::DEGRADED && last.message.find(of + ": silent for ") != std::string::npos;
  };
  const auto says_so = [&] { return !heartbeats.messages.empty() && silent("IMU"); };
  ASSERT_TRUE(handle_until(bus_, says_so));
  EXPECT_FALSE(silent("CAMERA") || silent("COMPASS")) << heartbeats.messages.back().message;
  const double seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - sent).count();
  EXPECT_GE(seconds, 1.9);
  EXPECT_LE(seconds, 5.0) << "two seconds, and a heartbeat each second";
  bus_.publish("IMU", &imu);
  EXPECT_TRUE(handle_until(bus_, [&] { return !silent("IMU"); })) << "it is back";
}

TEST_F(LiveNode, WhatComesFromTheBusMakesNoHeartbeatLong) {
  node_->subscribe<health_t>("NAMED", Delivery::kAll,
                             [this](const health_t& m) { node_->health().reject("named", m.message); });
  Collector<health_t> heartbeats(bus_, channel::kHealth);
  start();
  health_t forged{};
  forged.service = "live";
  forged.host = std::string(5'000, 'x');
  forged.pid = 7;
  forged.message = "\033[2J\n" + forged.host;
  health_counter_t published;
  published.name = "published.ECHO";
  forged.counters = {published};
  forged.num_counters = 1;
  bus_.publish(channel::kHealth, &forged);
  bus_.publish("NAMED", &forged);
  std::vector<health_t> own;
  const auto refused = [&] {
    own.clear();
    for (const health_t& m : heartbeats.messages) {
      if (m.pid != 7) own.push_back(m);
    }
    const auto counted = [&](const std::string& name) {
      return !own.empty() && std::any_of(own.back().counters.begin(), own.back().counters.end(),
                                         [&](const health_counter_t& c) { return c.name == name; });
    };
    return counted("rejected.heartbeat") && counted("rejected.named");
  };
  ASSERT_TRUE(handle_until(bus_, refused));
  for (const health_t& m : own) {
    EXPECT_LT(m.getEncodedSize(), 3000);
    EXPECT_TRUE(std::none_of(m.message.begin(), m.message.end(), [](unsigned char c) { return std::iscntrl(c) != 0; }));
  }
}

TEST_F(LiveNode, MessagesThatWaitFillNoMemory) {
  std::binary_semaphore go{0};
  std::atomic<bool> held = false;
  node_->subscribe<compass_t>("HOLD", Delivery::kAll, [&](const compass_t&) {
    if (held.exchange(true)) return;
    EXPECT_TRUE(go.try_acquire_for(5 * test::kPatience));
  });
  int images = 0;
  node_->subscribe<image_t>("LARGE", Delivery::kAll, [&](const image_t&) { ++images; });
  node_->subscribe<compass_t>("MARK", Delivery::kAll, [&](const compass_t& m) { node_->publish("HEARD", m); });
  Collector<compass_t> heard(bus_, "HEARD");
  Collector<image_t> sent(bus_, "LARGE");
  Collector<health_t> heartbeats(bus_, channel::kHealth);
  start();
  const compass_t mark{};
  ASSERT_TRUE(handle_until(bus_, [&] {
    if (!held) bus_.publish("HOLD", &mark);
    return held.load();
  }));
  // Of one packet each: of larger ones a machine that sends faster than it receives loses nearly all.
  image_t image{};
  image.data.resize(1'200);
  image.size = 1'200;
  constexpr size_t kImages = 150'000;  // 200 MB
  for (size_t k = 1; k <= kImages; ++k) {
    bus_.publish("LARGE", &image);
    ASSERT_TRUE(handle_until(bus_, [&] { return sent.messages.size() >= k; }));
    sent.messages.back() = {};
  }
  go.release();
  // Asked until it is heard: the queue may be full yet.
  const auto asked = [&] {
    bus_.publish("MARK", &mark);
    return !heard.messages.empty();
  };
  ASSERT_TRUE(handle_until(bus_, asked));
  const auto said = [&] {
    if (heartbeats.messages.empty()) return false;
    const std::vector<health_counter_t>& counters = heartbeats.messages.back().counters;
    return std::any_of(counters.begin(), counters.end(),
                       [](const health_counter_t& c) { return c.name == "rejected.overrun.LARGE" && c.value > 200; });
  };
  EXPECT_TRUE(handle_until(bus_, said));
  node_->stop();
  thread_.join();
  // What the sockets hold comes after.
  const int wait = (64 << 20) / image.getEncodedSize();
  EXPECT_GT(images, 0.9 * wait);
  EXPECT_LT(images, 1.1 * wait);
}

TEST(Node, ABusThatCannotBeJoinedIsAnErrorWithItsUrl) {
  try {
    const Node node({.service = "a", .lcm_url = "nonsense://here"});
    FAIL();
  } catch (const std::runtime_error& error) {
    EXPECT_THAT(error.what(), testing::HasSubstr("nonsense://here"));
  }
}

}  // namespace
}  // namespace orthonav
