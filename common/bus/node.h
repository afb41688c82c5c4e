// A service's place on the bus: typed subscriptions and publications, timers, heartbeat and orderly shutdown.
//
// A service is a class that takes a Node in its constructor and subscribes. The same class runs in two ways:
//   live      Node(options): an LCM URL of its own. A receive thread empties the socket into one queue; run()
//             calls handlers and timers one at a time on the caller's thread, so a service needs no locks.
//   replayed  Node(options, shared): several nodes in one process on one memq:// LCM. Handlers run in the order
//             of publication, timers by the time of the data, and Stopwatch reads 0, so a replay repeats bit for bit.
//
// With a key (seal.h), a live node seals what it sends and refuses what is not sealed; a replayed one does neither.
//
// A message whose utime is more than 30 s from those before it on its channel is refused (time_guard.h). Undecodable
// messages, these, messages lost by a full queue and handlers that throw are counted and shown in the
// heartbeat (health_t on channel HEALTH, once a second); they never end the process. So is another process that calls
// itself by the same service's name and publishes, and a channel that has fallen silent (expect()).
#pragma once

#include <chrono>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include <lcm/lcm-cpp.hpp>

#include "common/bus/time_guard.h"
#include "orthonav/health_t.hpp"
#include "orthonav/map_tile_request_t.hpp"
#include "orthonav/map_tile_t.hpp"
#include "orthonav/vio_reset_t.hpp"

namespace orthonav {

struct NodeOptions {
  std::string service;                   // name in the heartbeat
  std::string lcm_url = "";              // empty: LCM_DEFAULT_URL, else udpm://239.255.76.67:7667?ttl=0
  int receive_buffer = 4 * 1024 * 1024;  // bytes asked of the kernel (SO_RCVBUF) unless the URL says otherwise
  std::string key_file = "";             // of the authenticated mode (seal.h); empty: ORTHONAV_BUS_KEY, else none
  bool heartbeat = true;                 // a program that does its work and ends has none
};

// The URL a node with these options joins: with the default bus and the receive buffer filled in.
std::string bus_url(const NodeOptions& options);

// Joins it. Throws std::runtime_error naming the URL when that cannot be done, or what is sent does not come back.
std::unique_ptr<lcm::LCM> join_bus(const NodeOptions& options);

// What happens to messages that arrive faster than they are handled. When 64 MB wait in a node, what comes is given up
// and counted, of whatever kind.
enum class Delivery {
  kAll,      // all, in order: IMU, keyframes, fixes
  kLatest,   // at most `depth` wait; the oldest is given up and counted: images
  kReplace,  // one waits, a newer one takes its place, and nothing is lost by that: states, announcements
};

// Health of a service. Counters are shown in the heartbeat in order of their names.
class Health {
 public:
  enum class State : int8_t { kStarting = 0, kOk = 1, kDegraded = 2, kFailed = 3 };

  void set_state(State state, const std::string& message = "");
  void set(const std::string& counter, double value) { counters_[counter] = value; }
  void add(const std::string& counter, double amount = 1) { counters_[counter] += amount; }
  // Lets a live node's heartbeat go out with the next timer or message instead of within a second, as a new state does.
  void hurry() { hurried_ = true; }
  // Counts `amount` under `rejected.<what>` and for 5 s degrades the state, or adds to its message, with this one.
  void reject(const std::string& what, const std::string& message, double amount = 1);

  State state() const { return state_; }
  const std::string& message() const { return message_; }
  double counter(const std::string& name) const;

 private:
  friend class Node;
  State state_ = State::kStarting;
  std::string message_;
  std::map<std::string, double> counters_;
  std::string reject_message_;
  int64_t reject_until_ = 0;
  bool reject_pending_ = false;
  bool hurried_ = false;
};

class Node {
 public:
  // Live. Throws std::runtime_error as join_bus does, or naming the key file when it is no key.
  explicit Node(const NodeOptions& options);
  // Replayed, on a shared memq:// instance that outlives the node.
  Node(const NodeOptions& options, lcm::LCM& shared);
  ~Node();
  Node(const Node&) = delete;
  Node& operator=(const Node&) = delete;

  // Calls `handler` for each message of `channel` that decodes as Msg. `depth` is for Delivery::kLatest.
  template <class Msg>
  void subscribe(const std::string& channel, Delivery delivery, std::function<void(const Msg&)> handler,
                 size_t depth = 1) {
    subscribe_raw(
        channel, delivery, depth,
        [handler = std::move(handler), guard = TimeGuard(proof_of<Msg>())](const void* data, size_t size) mutable {
          Msg message;
          if (message.decode(data, 0, static_cast<int>(size)) < 0) return Handled::kUndecodable;
          // Heartbeats and requests for a reset come from many boards, whose clocks differ, and hours apart.
          if constexpr (!std::is_same_v<Msg, health_t> && !std::is_same_v<Msg, vio_reset_t>) {
            if (!guard.accept(message.utime)) return Handled::kFromAnotherTime;
          }
          handler(message);
          return Handled::kYes;
        });
  }

  // Says that messages come on a channel that was subscribed to all the time. Once one has been handled, the heartbeat
  // of a live node is DEGRADED, and says so, while none has for two seconds: a service whose state follows from what it
  // hears cannot see by itself that it hears nothing.
  void expect(const std::string& channel);

  // Sends a message. Failures are counted in the health.
  template <class Msg>
  void publish(const std::string& channel, const Msg& message) {
    if (sealing()) {
      std::vector<uint8_t> bytes(static_cast<size_t>(message.getEncodedSize()));
      message.encode(bytes.data(), 0, static_cast<int>(bytes.size()));
      publish_sealed(channel, std::move(bytes));
      return;
    }
    count_published(channel, message.getEncodedSize(), lcm().publish(channel, &message));
  }

  // Calls `handler` every `period`: on the monotonic clock when live, by the data's time when replayed.
  void every(std::chrono::microseconds period, std::function<void()> handler);

  // Handles messages and timers until stop(), SIGINT or SIGTERM. Live only. Returns 0.
  int run();
  // Ends run() after the current handler. Async-signal-safe and thread-safe.
  void stop();

  // Replayed only: fires the timers due up to `utime`, which becomes now().
  void advance(int64_t utime);

  // Microseconds since the Unix epoch: the wall clock when live, the data's time when replayed. For stamping
  // outgoing housekeeping messages (health, requests), never for an algorithm.
  int64_t now() const;
  // Microseconds of a clock that nobody sets, to wait by: the monotonic one when live, the data's time when replayed.
  int64_t steady_now() const;

  bool live() const;
  Health& health();

 private:
  // Requests and parts of a map come with long pauses between; all else is a stream.
  template <class Msg>
  static constexpr int64_t proof_of() {
    constexpr bool asked_for = std::is_same_v<Msg, map_tile_t> || std::is_same_v<Msg, map_tile_request_t>;
    return asked_for ? 0 : 2'000'000;
  }
  enum class Handled { kYes, kUndecodable, kFromAnotherTime };
  using RawHandler = std::function<Handled(const void* data, size_t size)>;
  void subscribe_raw(const std::string& channel, Delivery delivery, size_t depth, RawHandler handler);
  bool sealing() const;
  void publish_sealed(const std::string& channel, std::vector<uint8_t> message);
  void count_published(const std::string& channel, int size, int result);
  void publish_health();
  std::string silence() const;
  lcm::LCM& lcm();

  struct Impl;
  std::unique_ptr<Impl> impl_;
};

// Wall time of a piece of work, for the processing_ms fields: 0 in a replay, so that it repeats, unless timings
// were asked for with Stopwatch::enable_in_replay.
class Stopwatch {
 public:
  explicit Stopwatch(const Node& node);
  double ms() const;
  // Applies to all replayed nodes of the process; thread-safe.
  static void enable_in_replay(bool enabled);

 private:
  bool enabled_;
  std::chrono::steady_clock::time_point start_;
};

}  // namespace orthonav
