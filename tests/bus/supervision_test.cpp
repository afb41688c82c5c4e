// What a node tells those who watch over it: systemd's watchdog, and other boards' clocks.
#include <chrono>
#include <cstdlib>
#include <thread>

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include "common/bus/channels.h"
#include "common/bus/clock_skew.h"
#include "common/bus/node.h"
#include "common/bus/time_guard.h"
#include "orthonav/compass_t.hpp"
#include "tests/support/bus_client.h"
#include "tests/support/temporary_folder.h"

namespace orthonav {
namespace {

using namespace std::chrono_literals;
using test::Collector;
using test::handle_until;

// systemd's end of the notification socket.
class NotifySocket {
 public:
  NotifySocket() : fd_(socket(AF_UNIX, SOCK_DGRAM, 0)) {
    sockaddr_un address{};
    address.sun_family = AF_UNIX;
    const std::string path = folder_ / "notify";
    path.copy(address.sun_path, sizeof(address.sun_path) - 1);
    if (bind(fd_, reinterpret_cast<const sockaddr*>(&address), sizeof(address)) != 0) throw std::runtime_error("bind");
    setenv("NOTIFY_SOCKET", path.c_str(), 1);
    setenv("WATCHDOG_USEC", "200000", 1);
    unsetenv("WATCHDOG_PID");
  }
  ~NotifySocket() {
    unsetenv("NOTIFY_SOCKET");
    unsetenv("WATCHDOG_USEC");
    close(fd_);
  }
  // How many messages begin with `what` until the deadline.
  int count(const std::string& what, std::chrono::milliseconds deadline) const {
    int found = 0;
    const auto end = std::chrono::steady_clock::now() + deadline;
    while (std::chrono::steady_clock::now() < end) {
      char text[512] = {};
      const ssize_t size = recv(fd_, text, sizeof(text) - 1, MSG_DONTWAIT);
      if (size < 0) {
        std::this_thread::sleep_for(5ms);
      } else if (std::string(text).rfind(what, 0) == 0) {
        ++found;
      }
    }
    return found;
  }

 private:
  test::TemporaryFolder folder_;
  int fd_;
};

TEST(Supervision, TheWatchdogIsFedByTheLoopAndStarvesWhenAHandlerHangs) {
  const NotifySocket systemd;
  lcm::LCM bus;
  ASSERT_TRUE(bus.good());
  Node node({.service = "watched"});
  std::atomic<bool> hang{true};
  node.subscribe<compass_t>("HANG", Delivery::kAll, [&](const compass_t&) {
    while (hang) std::this_thread::sleep_for(1ms);
  });
  std::thread thread([&] { node.run(); });
  EXPECT_EQ(systemd.count("READY=1", 300ms), 1);
  EXPECT_GE(systemd.count("WATCHDOG=1", 400ms), 3) << "every 50 ms";
  const compass_t message{};
  bus.publish("HANG", &message);
  systemd.count("", 200ms);
  EXPECT_EQ(systemd.count("WATCHDOG=1", 300ms), 0);
  hang = false;
  EXPECT_GE(systemd.count("WATCHDOG=1", 400ms), 1);
  node.stop();
  thread.join();
}

TEST(Supervision, AnotherBoardsClockIsMeasuredAndComplainedOf) {
  lcm::LCM bus;
  ASSERT_TRUE(bus.good());
  Node node({.service = "here"});
  node.health().set_state(Health::State::kOk);
  Collector<health_t> heartbeats(bus, channel::kHealth);
  std::thread thread([&] { node.run(); });
  health_t other{};
  other.service = "there";
  other.host = "board2";
  other.utime = node.now() - 500'000;
  bus.publish(channel::kHealth, &other);
  const auto skew = [&] {
    for (auto h = heartbeats.messages.rbegin(); h != heartbeats.messages.rend(); ++h) {
      for (const auto& counter : h->counters) {
        if (h->service == "here" && counter.name == "clock.skew_ms.board2") return counter.value;
      }
    }
    return 0.0;
  };
  EXPECT_TRUE(handle_until(bus, [&] { return skew() != 0; }));
  EXPECT_NEAR(skew(), 500, 100);
  EXPECT_EQ(heartbeats.messages.back().state, +health_t::DEGRADED);
  EXPECT_THAT(heartbeats.messages.back().message, testing::HasSubstr("clock of board2"));
  node.stop();
  thread.join();
}

TEST(ClockSkew, TheSwiftestHeartbeatCountsAndSilentHostsAreForgotten) {
  ClockSkew skew;
  for (int i = 0; i < 5; ++i) skew.add("a", 1'000'000 + i * 1'000'000, 1'030'000 + i * 1'000'000 + (i == 2 ? 0 : 9000));
  EXPECT_NEAR(skew.skews(6'000'000).at("a"), 0.030, 1e-9);
  EXPECT_TRUE(skew.skews(30'000'000).empty());
}

TEST(ClockSkew, AFloodOfMadeUpHostsDoesNotGrow) {
  ClockSkew skew;
  for (int i = 0; i < 10'000; ++i) skew.add(std::to_string(i), INT64_MIN, 1'000'000);
  EXPECT_LE(skew.skews(1'000'000).size(), 16u);
}

TEST(TimeGuard, AStampFromTomorrowIsRefusedAndTheTrueOnesGoOn) {
  TimeGuard guard;
  for (int64_t i = 0; i < 10; ++i) {
    EXPECT_TRUE(guard.accept(1'000'000'000 + i * 5000));
    EXPECT_FALSE(guard.accept(86'400'000'000 + i));
    EXPECT_FALSE(guard.accept(INT64_MIN + i));
  }
}

TEST(TimeGuard, ATimeOfNoClockDoesNotBeginAStream) {
  TimeGuard guard;
  for (const int64_t none : {INT64_MIN, int64_t{-1}, INT64_MAX, (int64_t{1} << 53) + 1}) {
    for (int repeated = 0; repeated < 5; ++repeated) EXPECT_FALSE(guard.accept(none));
  }
  EXPECT_TRUE(guard.accept(1'000'000'000)) << "the first true one is taken at once";
}

TEST(TimeGuard, ANewFlightIsTakenOverWhenItHasLastedTwoSeconds) {
  TimeGuard guard;
  EXPECT_TRUE(guard.accept(1'000'000'000));
  for (int64_t t = 5'000'000; t < 7'000'000; t += 100'000) EXPECT_FALSE(guard.accept(t));
  EXPECT_TRUE(guard.accept(7'000'000));
  EXPECT_TRUE(guard.accept(7'100'000));
}

TEST(TimeGuard, AFloodFromTomorrowDoesNotDisplaceAStreamOfOneMessageASecond) {
  TimeGuard guard;
  for (int64_t second = 0; second < 20; ++second) {
    EXPECT_TRUE(guard.accept(1'000'000'000 + second * 1'000'000));
    for (int64_t i = 1; i < 100; ++i) {
      EXPECT_FALSE(guard.accept(87'400'000'000 + second * 1'000'000 + i * 10'000)) << "all of them agree";
    }
  }
}

TEST(TimeGuard, WhatIsAskedForHoursLaterIsTakenOverAtItsThirdMessage) {
  TimeGuard guard(0);
  EXPECT_TRUE(guard.accept(1'000'000'000));
  EXPECT_FALSE(guard.accept(10'000'000'000));
  EXPECT_FALSE(guard.accept(10'000'000'000));
  EXPECT_TRUE(guard.accept(10'000'000'000));
}

TEST(TimeGuard, AGapOfTwentySecondsCostsNothing) {
  TimeGuard guard;
  EXPECT_TRUE(guard.accept(1'000'000'000));
  EXPECT_TRUE(guard.accept(1'020'000'000));
}

}  // namespace
}  // namespace orthonav
