#include "common/bus/node.h"

#include <algorithm>
#include <atomic>
#include <cctype>
#include <cmath>
#include <condition_variable>
#include <csignal>
#include <cstdlib>
#include <deque>
#include <mutex>
#include <optional>
#include <stdexcept>
#include <thread>
#include <vector>

#include <fmt/format.h>
#include <netinet/in.h>
#include <spdlog/spdlog.h>
#include <sys/socket.h>
#include <unistd.h>

#include "common/bus/channels.h"
#include "common/bus/clock_skew.h"
#include "common/bus/process_usage.h"
#include "common/bus/seal.h"
#include "common/bus/supervisor.h"

namespace orthonav {

namespace {

using Clock = std::chrono::steady_clock;

constexpr int64_t kRejectDegradesFor = 5'000'000;          // microseconds
constexpr auto kStopPoll = std::chrono::milliseconds(50);  // how soon run() sees a signal
constexpr double kTolerableSkew = 0.1;                     // s
constexpr auto kTwinIsThere = std::chrono::seconds(3);     // after its last heartbeat
constexpr int64_t kLargestTimerLag = 10'000'000;           // microseconds of replayed time that timers catch up on
constexpr int64_t kSilence = 2'000'000;                    // microseconds without a message that is expected
constexpr size_t kMostWaiting = size_t{64} << 20;          // bytes of messages that wait to be handled
constexpr size_t kLongestName = 64;                        // of a host or a service
constexpr size_t kLongestMessage = 1000;                   // of a heartbeat

std::atomic<bool> g_signalled{false};
std::atomic<bool> g_stopwatch_in_replay{false};

void on_signal(int) {
  g_signalled = true;
}

int64_t monotonic() {
  return std::chrono::duration_cast<std::chrono::microseconds>(Clock::now().time_since_epoch()).count();
}

// Part of what a heartbeat says may come from the bus: it is no longer than a line, and a line.
std::string one_line(std::string text) {
  if (text.size() > kLongestMessage) text.replace(kLongestMessage, std::string::npos, " ...");
  std::replace_if(
      text.begin(), text.end(), [](unsigned char c) { return std::iscntrl(c) != 0; }, ' ');
  return text;
}

std::string host_name() {
  char name[256] = {};
  return gethostname(name, sizeof(name) - 1) == 0 ? name : "unknown";
}

int64_t wall_time() {
  return std::chrono::duration_cast<std::chrono::microseconds>(std::chrono::system_clock::now().time_since_epoch())
      .count();
}

// The kernel clamps a receive buffer to net.core.rmem_max without a word, and LCM does not show its socket. A
// socket of our own is clamped alike. Returns the bytes the kernel granted, as asked for (it doubles them inside).
int granted_receive_buffer(int wanted) {
  const int fd = socket(AF_INET, SOCK_DGRAM, 0);
  if (fd < 0) return wanted;
  int granted = 0;
  socklen_t length = sizeof(granted);
  setsockopt(fd, SOL_SOCKET, SO_RCVBUF, &wanted, sizeof(wanted));
  getsockopt(fd, SOL_SOCKET, SO_RCVBUF, &granted, &length);
  close(fd);
  return granted / 2;
}

}  // namespace

std::string bus_url(const NodeOptions& options) {
  std::string url = options.lcm_url;
  if (url.empty()) {
    const char* from_environment = std::getenv("LCM_DEFAULT_URL");
    url =
        from_environment != nullptr && *from_environment != '\0' ? from_environment : "udpm://239.255.76.67:7667?ttl=0";
  }
  if (url.rfind("udpm", 0) == 0 && url.find("recv_buf_size") == std::string::npos) {
    url += fmt::format("{}recv_buf_size={}", url.find('?') == std::string::npos ? '?' : '&', options.receive_buffer);
  }
  return url;
}

std::unique_ptr<lcm::LCM> join_bus(const NodeOptions& options) {
  const std::string url = bus_url(options);
  auto bus = std::make_unique<lcm::LCM>(url);
  if (!bus->good()) {
    throw std::runtime_error(
        fmt::format("cannot join the bus at {}: is there a multicast route? (ip route add "
                    "224.0.0.0/4 dev lo)",
                    url));
  }
  // LCM begins to receive here, and proves it to itself, for ten seconds at most.
  if (url.starts_with("udpm") && bus->getFileno() < 0) {
    throw std::runtime_error(
        fmt::format("nothing comes back from the bus at {}: does a firewall drop it? (nft list ruleset)", url));
  }
  return bus;
}

// ---- Health ---------------------------------------------------------------------------------------------------------

void Health::set_state(State state, const std::string& message) {
  state_ = state;
  message_ = message;
}

void Health::reject(const std::string& what, const std::string& message, double amount) {
  add("rejected." + what, amount);
  reject_message_ = message;
  reject_pending_ = true;
}

double Health::counter(const std::string& name) const {
  const auto it = counters_.find(name);
  return it == counters_.end() ? 0.0 : it->second;
}

// ---- Node -----------------------------------------------------------------------------------------------------------

struct Node::Impl {
  struct Subscription {
    std::string channel;
    Delivery delivery;
    size_t depth;
    RawHandler handler;
    Node* node = nullptr;
    lcm::Subscription* on_bus = nullptr;
    size_t waiting = 0;   // guarded by queue_mutex
    int64_t dropped = 0;  // guarded by queue_mutex
    int64_t refused = 0;  // for their seal; guarded by queue_mutex, as the next
    std::string refusal;  // of the last one
    int64_t reported_refused = 0;
    int64_t reported = 0;
    double slowest_ms = 0;  // since the last heartbeat, from the socket to the end of the handler
    bool expected = false;
    int64_t handled_at = 0;  // the last, steady; 0: none yet
    // With a key; only for the receive thread. One for each, for a message that comes to two of them is no replay.
    std::optional<SealChecker> seals;

    void receive(const lcm::ReceiveBuffer* buffer, const std::string&);
  };
  struct Message {
    Subscription* subscription;
    std::vector<uint8_t> data;
    Clock::time_point received;

    size_t size() const { return sizeof(Message) + data.size(); }
  };
  struct Timer {
    int64_t period;
    std::function<void()> handler;
    int64_t due = 0;
    bool started = false;
  };

  NodeOptions options;
  std::unique_ptr<lcm::LCM> own;
  lcm::LCM* shared = nullptr;
  int64_t replay_now = 0;
  int64_t start = 0;  // steady, as the times below
  std::atomic<bool> stopping{false};
  Health health;
  Health::State published_state = Health::State::kStarting;
  std::string buffer_message;
  std::string skew_message;
  std::string twin_message;
  Clock::time_point twin_heard;
  ProcessUsage usage;
  ClockSkew skew;
  Supervisor supervisor;
  std::vector<std::unique_ptr<Subscription>> subscriptions;
  std::vector<Timer> timers;
  std::optional<BusKey> key;
  std::optional<Sealer> sealer;  // with a key

  std::mutex queue_mutex;
  std::condition_variable queue_filled;
  std::deque<Message> queue;
  size_t bytes_waiting = 0;  // in the queue

  int64_t steady_now() const { return own ? monotonic() : replay_now; }

  void dispatch(Subscription& subscription, const void* data, size_t size) {
    health.add("received." + subscription.channel);
    try {
      switch (subscription.handler(data, size)) {
        case Handled::kYes:
          subscription.handled_at = steady_now();
          break;
        case Handled::kUndecodable:
          health.reject("undecodable." + subscription.channel,
                        fmt::format("{}: a message of {} bytes does not decode: is its publisher of another version?",
                                    subscription.channel, size));
          break;
        case Handled::kFromAnotherTime:
          health.reject("time." + subscription.channel,
                        fmt::format("{}: a message is stamped more than 30 s from those before it: are there two "
                                    "publishers?",
                                    subscription.channel));
      }
    } catch (const std::exception& error) {
      health.reject("exception." + subscription.channel, fmt::format("{}: {}", subscription.channel, error.what()));
      spdlog::error("{}: {}: {}", options.service, subscription.channel, error.what());
    }
  }

  void enqueue(Subscription& subscription, const lcm::ReceiveBuffer& buffer) {
    const auto* bytes = static_cast<const uint8_t*>(buffer.data);
    // Here, before the queue: a forged message must not take the place of a true one.
    if (subscription.seals) {
      std::string refusal = subscription.seals->refusal(subscription.channel, wall_time(), bytes, buffer.data_size);
      if (!refusal.empty()) {
        const std::lock_guard lock(queue_mutex);
        ++subscription.refused;
        subscription.refusal = std::move(refusal);
        return;
      }
    }
    Message message{&subscription, {bytes, bytes + buffer.data_size}, Clock::now()};
    {
      const std::lock_guard lock(queue_mutex);
      const auto first = subscription.delivery == Delivery::kAll || subscription.waiting < subscription.depth
                             ? queue.end()
                             : std::find_if(queue.begin(), queue.end(),
                                            [&](const Message& m) { return m.subscription == &subscription; });
      const size_t leaving = first == queue.end() ? 0 : first->size();
      if (bytes_waiting - leaving + message.size() > kMostWaiting) {
        ++subscription.dropped;
        return;
      }
      bytes_waiting += message.size() - leaving;
      if (first != queue.end() && subscription.delivery == Delivery::kReplace) {
        // In its place: at the end of the queue, it could be replaced for ever.
        *first = std::move(message);
        return;
      }
      if (first != queue.end()) {
        queue.erase(first);
        --subscription.waiting;
        ++subscription.dropped;
      }
      ++subscription.waiting;
      queue.push_back(std::move(message));
    }
    queue_filled.notify_one();
  }

  void measure(int64_t time);
  void hear(const health_t& heartbeat, int64_t time);

  void report_drops() {
    for (const auto& subscription : subscriptions) {
      int64_t dropped = 0, refused = 0;
      std::string refusal;
      {
        const std::lock_guard lock(queue_mutex);
        dropped = subscription->dropped;
        refused = subscription->refused;
        if (refused != subscription->reported_refused) refusal = subscription->refusal;
      }
      if (!refusal.empty()) {
        health.reject("seal." + subscription->channel, fmt::format("{}: a message {}", subscription->channel, refusal));
        health.set("rejected.seal." + subscription->channel, static_cast<double>(refused));
        subscription->reported_refused = refused;
      }
      if (dropped == subscription->reported) continue;
      health.reject("overrun." + subscription->channel,
                    fmt::format("{}: {} messages given up because they came faster than they could be handled",
                                subscription->channel, dropped));
      health.set("rejected.overrun." + subscription->channel, static_cast<double>(dropped));
      subscription->reported = dropped;
    }
  }

  // Fires what is due at `now` (microseconds); returns when the next timer is due.
  int64_t fire_timers(int64_t now) {
    int64_t next = now + 1'000'000;
    // By index: a handler may add timers.
    for (size_t i = 0; i < timers.size(); ++i) {
      if (!timers[i].started) {
        timers[i].started = true;
        timers[i].due = now + timers[i].period;
      }
      if (now - timers[i].due > kLargestTimerLag) timers[i].due = now;
      while (timers[i].due <= now) {
        timers[i].due += timers[i].period;
        try {
          const auto handler = timers[i].handler;
          handler();
        } catch (const std::exception& error) {
          health.reject("exception.timer", error.what());
          spdlog::error("{}: timer: {}", options.service, error.what());
        }
      }
      next = std::min(next, timers[i].due);
    }
    return next;
  }
};

void Node::Impl::Subscription::receive(const lcm::ReceiveBuffer* buffer, const std::string&) {
  Impl& impl = *node->impl_;
  if (node->live()) {
    impl.enqueue(*this, *buffer);
  } else {
    impl.dispatch(*this, buffer->data, buffer->data_size);
  }
}

Node::Node(const NodeOptions& options) : impl_(std::make_unique<Impl>()) {
  impl_->options = options;
  impl_->own = join_bus(options);
  std::string key_file = options.key_file;
  if (const char* named = std::getenv("ORTHONAV_BUS_KEY"); key_file.empty() && named != nullptr) key_file = named;
  if (!key_file.empty()) {
    impl_->key = read_bus_key(key_file);
    impl_->sealer.emplace(*impl_->key);
  }
  impl_->start = steady_now();
  if (bus_url(options).starts_with("udpm")) {
    const int granted = granted_receive_buffer(options.receive_buffer);
    impl_->health.set("bus.receive_buffer", granted);
    if (granted < options.receive_buffer) {
      impl_->buffer_message = fmt::format(
          "receive buffer clamped to {} of {} bytes, large images may be lost: sysctl -w "
          "net.core.rmem_max={}",
          granted, options.receive_buffer, options.receive_buffer);
      spdlog::warn("{}: {}", options.service, impl_->buffer_message);
    }
  }
  subscribe<health_t>(channel::kHealth, Delivery::kAll, [this](const health_t& m) { impl_->hear(m, now()); });
  every(std::chrono::seconds(1), [this] { publish_health(); });
}

Node::Node(const NodeOptions& options, lcm::LCM& shared) : impl_(std::make_unique<Impl>()) {
  impl_->options = options;
  impl_->shared = &shared;
  every(std::chrono::seconds(1), [this] { publish_health(); });
}

Node::~Node() {
  if (impl_->shared == nullptr) return;
  // The bus outlives this node: another may take its place.
  for (const auto& subscription : impl_->subscriptions) impl_->shared->unsubscribe(subscription->on_bus);
}

lcm::LCM& Node::lcm() {
  return impl_->own ? *impl_->own : *impl_->shared;
}
bool Node::live() const {
  return impl_->own != nullptr;
}
Health& Node::health() {
  return impl_->health;
}

void Node::subscribe_raw(const std::string& channel, Delivery delivery, size_t depth, RawHandler handler) {
  auto subscription = std::make_unique<Impl::Subscription>();
  subscription->channel = channel;
  subscription->delivery = delivery;
  subscription->depth = delivery == Delivery::kReplace ? 1 : std::max<size_t>(depth, 1);
  subscription->handler = std::move(handler);
  subscription->node = this;
  if (impl_->key) subscription->seals.emplace(*impl_->key);
  // LCM's own queue of 30 would drop the newest; ours, behind it, does what `delivery` says.
  subscription->on_bus = lcm().subscribe(channel, &Impl::Subscription::receive, subscription.get());
  subscription->on_bus->setQueueCapacity(0);
  impl_->subscriptions.push_back(std::move(subscription));
}

bool Node::sealing() const {
  return impl_->sealer.has_value();
}

void Node::publish_sealed(const std::string& channel, std::vector<uint8_t> message) {
  impl_->sealer->seal(channel, now(), message);
  count_published(channel, static_cast<int>(message.size()),
                  lcm().publish(channel, message.data(), static_cast<unsigned>(message.size())));
}

void Node::count_published(const std::string& channel, int size, int result) {
  if (result != 0) {
    impl_->health.reject("unsent." + channel,
                         fmt::format("{}: a message of {} bytes could not be sent", channel, size));
  } else {
    impl_->health.add("published." + channel);
  }
}

void Node::every(std::chrono::microseconds period, std::function<void()> handler) {
  impl_->timers.push_back({period.count(), std::move(handler)});
}

int64_t Node::now() const {
  if (!live()) return impl_->replay_now;
  return wall_time();
}

int64_t Node::steady_now() const {
  return impl_->steady_now();
}

void Node::expect(const std::string& channel) {
  for (const auto& subscription : impl_->subscriptions) {
    if (subscription->channel == channel) subscription->expected = true;
  }
}

void Node::advance(int64_t utime) {
  if (impl_->start == 0) impl_->start = utime;
  impl_->replay_now = std::max(impl_->replay_now, utime);
  impl_->fire_timers(impl_->replay_now);
}

void Node::stop() {
  impl_->stopping = true;
}

int Node::run() {
  std::signal(SIGINT, on_signal);
  std::signal(SIGTERM, on_signal);
  const auto stopping = [this] { return impl_->stopping || g_signalled; };
  std::thread receiver([&] {
    while (!stopping()) impl_->own->handleTimeout(static_cast<int>(kStopPoll.count()));
  });
  publish_health();
  while (!stopping()) {
    const int64_t due = impl_->fire_timers(monotonic());
    impl_->report_drops();
    if (impl_->health.state() != impl_->published_state || impl_->health.hurried_) publish_health();
    std::optional<Impl::Message> message;
    {
      std::unique_lock lock(impl_->queue_mutex);
      const auto patience = std::chrono::microseconds(std::max<int64_t>(0, due - monotonic()));
      impl_->queue_filled.wait_for(lock, std::min<std::chrono::microseconds>(patience, kStopPoll),
                                   [&] { return !impl_->queue.empty(); });
      if (!impl_->queue.empty()) {
        message = std::move(impl_->queue.front());
        impl_->queue.pop_front();
        impl_->bytes_waiting -= message->size();
        --message->subscription->waiting;
      }
    }
    if (message) {
      impl_->dispatch(*message->subscription, message->data.data(), message->data.size());
      double& slowest = message->subscription->slowest_ms;
      slowest = std::max(slowest, std::chrono::duration<double, std::milli>(Clock::now() - message->received).count());
    }
    impl_->supervisor.alive();
  }
  receiver.join();
  return 0;
}

void Node::Impl::hear(const health_t& heartbeat, int64_t time) {
  const std::string host = host_name();
  // What follows is said again in this one's own heartbeats.
  if (heartbeat.host.size() > kLongestName || heartbeat.service.size() > kLongestName) {
    health.reject("heartbeat", "HEALTH: a heartbeat of a host or service whose name is longer than any");
    return;
  }
  if (heartbeat.host != host) skew.add(heartbeat.host, heartbeat.utime, time);
  if (heartbeat.service != options.service || (heartbeat.host == host && heartbeat.pid == getpid())) return;
  const auto speaks = [](const health_counter_t& counter) { return counter.name.starts_with("published."); };
  if (std::none_of(heartbeat.counters.begin(), heartbeat.counters.end(), speaks)) return;
  twin_message = fmt::format("another {} is on the bus, process {} on {}, and its messages mix with these: stop one",
                             options.service, heartbeat.pid, heartbeat.host);
  twin_heard = Clock::now();
}

// What only a live node has: load, waiting times, other boards' clocks.
void Node::Impl::measure(int64_t time) {
  health.set("cpu.percent", usage.cpu_percent());
  health.set("memory.bytes", ProcessUsage::resident_bytes());
  for (const auto& subscription : subscriptions) {
    health.set("latency_ms." + subscription->channel, subscription->slowest_ms);
    subscription->slowest_ms = 0;
  }
  if (Clock::now() - twin_heard > kTwinIsThere) twin_message.clear();
  skew_message.clear();
  std::erase_if(health.counters_, [](const auto& counter) { return counter.first.starts_with("clock.skew_ms."); });
  for (const auto& [host, skew_s] : skew.skews(time)) {
    health.set("clock.skew_ms." + host, 1e3 * skew_s);
    if (std::abs(skew_s) > kTolerableSkew) {
      skew_message = fmt::format("the clock of {} is {:.3f} s {} this one: is chrony running on both?", host,
                                 std::abs(skew_s), skew_s > 0 ? "behind" : "ahead of");
    }
  }
}

std::string Node::silence() const {
  std::string message;
  for (const auto& subscription : impl_->subscriptions) {
    const int64_t silent = steady_now() - subscription->handled_at;
    if (!live() || !subscription->expected || subscription->handled_at == 0 || silent < kSilence) continue;
    // Who was held up himself has no silence to complain of.
    const std::lock_guard lock(impl_->queue_mutex);
    if (subscription->waiting > 0) continue;
    message += fmt::format("{}{}: silent for {:.0f} s", message.empty() ? "" : "; ", subscription->channel,
                           1e-6 * static_cast<double>(silent));
  }
  return message;
}

void Node::publish_health() {
  if (!impl_->options.heartbeat) return;
  Health& health = impl_->health;
  const int64_t time = now(), steady = steady_now();
  if (live()) impl_->measure(time);
  if (health.reject_pending_) {
    health.reject_until_ = steady + kRejectDegradesFor;
    health.reject_pending_ = false;
  }
  health_t message;
  message.utime = time;
  message.service = impl_->options.service;
  message.host = live() ? host_name() : "replay";
  message.version = ORTHONAV_VERSION;
  message.pid = live() ? static_cast<int32_t>(getpid()) : 0;
  Health::State state = health.state_;
  message.message = health.message_;
  // What is refused or silent may well be what a service waits for.
  for (const std::string& trouble : {silence(), steady < health.reject_until_ ? health.reject_message_ : ""}) {
    if (trouble.empty() || message.message.find(trouble) != std::string::npos) continue;
    if (state == Health::State::kOk) state = Health::State::kDegraded;
    message.message += (message.message.empty() ? "" : "; ") + trouble;
  }
  for (const std::string& warning : {impl_->twin_message, impl_->buffer_message, impl_->skew_message}) {
    if (state != Health::State::kOk || warning.empty()) continue;
    state = Health::State::kDegraded;
    message.message = warning;
  }
  message.message = one_line(message.message);
  message.state = static_cast<int8_t>(state);
  message.uptime = static_cast<double>(steady - impl_->start) * 1e-6;
  for (const auto& [name, value] : health.counters_) {
    health_counter_t counter;
    counter.name = name;
    counter.value = value;
    message.counters.push_back(std::move(counter));
  }
  message.num_counters = static_cast<int32_t>(message.counters.size());
  impl_->published_state = health.state_;
  health.hurried_ = false;
  if (sealing()) {
    std::vector<uint8_t> bytes(static_cast<size_t>(message.getEncodedSize()));
    message.encode(bytes.data(), 0, static_cast<int>(bytes.size()));
    impl_->sealer->seal(channel::kHealth, time, bytes);
    lcm().publish(channel::kHealth, bytes.data(), static_cast<unsigned>(bytes.size()));
  } else {
    lcm().publish(channel::kHealth, &message);
  }
  if (live()) impl_->supervisor.status(message.message.empty() ? "running" : message.message);
}

// ---- Stopwatch ------------------------------------------------------------------------------------------------------

Stopwatch::Stopwatch(const Node& node) : enabled_(node.live() || g_stopwatch_in_replay), start_(Clock::now()) {}

double Stopwatch::ms() const {
  return enabled_ ? std::chrono::duration<double, std::milli>(Clock::now() - start_).count() : 0.0;
}

void Stopwatch::enable_in_replay(bool enabled) {
  g_stopwatch_in_replay = enabled;
}

}  // namespace orthonav
