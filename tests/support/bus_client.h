// A test's ear on the bus: waits for a message with a deadline instead of sleeping.
#pragma once

#include <chrono>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include <lcm/lcm-cpp.hpp>

namespace orthonav::test {

inline constexpr std::chrono::milliseconds kPatience{20000};

// Collects the messages of one channel.
template <class Msg>
class Collector {
 public:
  Collector(lcm::LCM& bus, const std::string& channel) {
    bus.subscribe(channel, &Collector::receive, this)->setQueueCapacity(0);
  }
  std::vector<Msg> messages;

 private:
  void receive(const lcm::ReceiveBuffer*, const std::string&, const Msg* message) { messages.push_back(*message); }
};

// Handles messages until `done`, at most until the deadline; says whether it came true.
inline bool handle_until(lcm::LCM& bus, const std::function<bool()>& done,
                         std::chrono::milliseconds deadline = kPatience) {
  const auto end = std::chrono::steady_clock::now() + deadline;
  while (!done()) {
    if (std::chrono::steady_clock::now() >= end) return false;
    bus.handleTimeout(20);
  }
  return true;
}

}  // namespace orthonav::test
