#include "tools/replay/replay.h"

#include <algorithm>
#include <fstream>
#include <memory>
#include <optional>
#include <set>
#include <stdexcept>
#include <vector>

#include <fmt/format.h>
#include <lcm/lcm-cpp.hpp>

#include "common/bus/channels.h"
#include "common/bus/node.h"
#include "common/bus/process_usage.h"
#include "common/flightlog/flightlog.h"
#include "orthonav/nav_state_t.hpp"
#include "orthonav/vio_state_t.hpp"
#include "services/fusion/fusion_service.h"
#include "services/ingest/ingest_service.h"
#include "services/map_server/map_server_service.h"
#include "services/registration/registration_service.h"
#include "services/vio/asl_setup.h"
#include "services/vio/vio_service.h"

namespace orthonav::replay {

namespace {

// A stamp further ahead is out of order: the validator's to judge, and not to move the clock of everybody else.
constexpr int64_t kAnHour = 3'600'000'000;

// Writes everything on the bus, stamped with the data's time.
class Recorder {
 public:
  explicit Recorder(lcm::LCM& bus) { bus.subscribe(".*", &Recorder::record, this)->setQueueCapacity(0); }

  // Begins a new log, in place of the last one.
  void begin(const std::filesystem::path& file) {
    writer_.reset();
    if (!file.empty()) writer_.emplace(file);
  }

  int64_t utime = 0;
  int64_t messages = 0;

 private:
  void record(const lcm::ReceiveBuffer* buffer, const std::string& channel) {
    if (writer_) writer_->write(utime, channel, buffer->data, buffer->data_size);
    ++messages;
  }

  std::optional<LogWriter> writer_;
};

// The odometry's states as text, for other tools: its trajectory, a comment where a session begins, and a table of
// what each image cost.
class OdometryText {
 public:
  OdometryText(lcm::LCM& bus, const std::filesystem::path& trajectory, const std::filesystem::path& times) {
    open(trajectory, trajectory_);
    open(times, times_);
    if (times_.is_open()) times_ << "# time_s,processing_ms,status,session,features\n";
    bus.subscribe(channel::kVioState, &OdometryText::write, this)->setQueueCapacity(0);
  }

 private:
  static void open(const std::filesystem::path& file, std::ofstream& stream) {
    if (file.empty()) return;
    stream.open(file);
    if (!stream) throw std::runtime_error(fmt::format("{}: cannot be written", file.string()));
  }

  void write(const lcm::ReceiveBuffer*, const std::string&, const vio_state_t* state) {
    const std::string time = fmt::format("{}.{:06d}", state->utime / 1'000'000, state->utime % 1'000'000);
    if (times_.is_open()) {
      times_ << fmt::format("{},{:.3f},{},{},{}\n", time, state->processing_ms, static_cast<int>(state->status),
                            state->session, state->num_tracked);
    }
    if (!trajectory_.is_open() || state->status == vio_state_t::INITIALISING) return;
    if (state->session != session_) trajectory_ << fmt::format("# session {}\n", state->session);
    session_ = state->session;
    const double *p = state->p_W_B, *q = state->q_W_B;
    trajectory_ << fmt::format("{} {:.6f} {:.6f} {:.6f} {:.9f} {:.9f} {:.9f} {:.9f}\n", time, p[0], p[1], p[2], q[1],
                               q[2], q[3], q[0]);
  }

  std::ofstream trajectory_, times_;
  int session_ = 0;
};

// A source flown again and again: each time begins after the one before it, and the clock goes on.
class Repeated {
 public:
  Repeated(ingest::IngestOptions options, int loops) : options_(std::move(options)), left_(loops) { next_flight(); }

  // Begins another flight; false when there is none left.
  bool next_flight() {
    if (left_ <= 0) return false;
    --left_;
    source_ = ingest::make_source(options_);
    if (last_ != 0) begin_ = last_ + 10'000'000;
    first_.reset();
    return true;
  }
  std::optional<ingest::SensorEvent> next() {
    auto event = source_->next();
    if (!event || !event->message) return event;
    std::visit(
        [&](auto& message) {
          if (!first_) first_ = message.utime;
          if (begin_) message.utime += *begin_ - *first_;
          if (last_ == 0 || (message.utime > last_ && message.utime - last_ < kAnHour)) last_ = message.utime;
        },
        *event->message);
    return event;
  }
  double progress() const { return source_->progress(); }

 private:
  const ingest::IngestOptions options_;
  int left_;
  std::unique_ptr<ingest::SensorSource> source_;
  int64_t last_ = 0;              // newest stamp
  std::optional<int64_t> first_;  // stamp in the source with which this flight begins
  std::optional<int64_t> begin_;  // what it is made, after the first flight
};

// What the flights so far have cost and reached.
class Landings {
 public:
  explicit Landings(lcm::LCM& bus) {
    bus.subscribe(channel::kVioState, &Landings::hear_odometry, this)->setQueueCapacity(0);
    bus.subscribe(channel::kNavState, &Landings::hear_fusion, this)->setQueueCapacity(0);
  }

  LoopSummary land(double seconds) {
    const double cpu_seconds = ProcessUsage::cpu_seconds();
    const LoopSummary summary{.hours = seconds / 3600,
                              .cpu_ms = 1e3 * (cpu_seconds - cpu_seconds_) / std::max(1, images_),
                              .resident_mb = 1e-6 * ProcessUsage::resident_bytes(),
                              .aided_percent = 100.0 * aided_ / std::max(1, states_),
                              .sessions = static_cast<int>(sessions_.size())};
    cpu_seconds_ = cpu_seconds;
    images_ = states_ = aided_ = 0;
    return summary;
  }

 private:
  void hear_odometry(const lcm::ReceiveBuffer*, const std::string&, const vio_state_t* state) {
    ++images_;
    if (state->status != vio_state_t::INITIALISING) sessions_.insert(state->session);
  }
  void hear_fusion(const lcm::ReceiveBuffer*, const std::string&, const nav_state_t* state) {
    ++states_;
    aided_ += state->mode == nav_state_t::MAP_AIDED ? 1 : 0;
  }

  double cpu_seconds_ = 0;
  int images_ = 0, states_ = 0, aided_ = 0;
  std::set<int> sessions_;
};

// A service, and when it ends and begins again.
struct Running {
  using Start = std::function<std::unique_ptr<Service>(Node&)>;
  std::string name;
  Start start;
  std::vector<Restart> restarts{};  // to come, the next one last
  std::unique_ptr<Node> node{};
  std::unique_ptr<Service> service{};

  void stop() {
    service.reset();
    node.reset();
  }
  void restart(lcm::LCM& bus) {
    stop();
    node = std::make_unique<Node>(NodeOptions{.service = name}, bus);
    service = start(*node);
  }
  void advance(lcm::LCM& bus, int64_t utime, double seconds) {
    if (!restarts.empty() && seconds >= restarts.back().at) {
      if (seconds < restarts.back().at + restarts.back().down) {
        stop();
      } else {
        restarts.pop_back();
        restart(bus);
      }
    }
    if (node) node->advance(utime);
  }
};

void schedule(std::vector<Restart> restarts, std::vector<Running>& running) {
  std::sort(restarts.begin(), restarts.end(), [](const Restart& a, const Restart& b) { return a.at > b.at; });
  for (const Restart& restart : restarts) {
    const auto found = std::find_if(running.begin(), running.end(),
                                    [&](const Running& service) { return service.name == restart.service; });
    if (found == running.end()) {
      throw std::runtime_error(
          fmt::format("{}: no service of this replay can be restarted by that name", restart.service));
    }
    found->restarts.push_back(restart);
  }
}

}  // namespace

ReplaySummary replay(const ReplayOptions& options) {
  lcm::LCM bus("memq://");
  Recorder recorder(bus);
  Landings landings(bus);
  OdometryText text(bus, options.trajectory, options.times);
  Node ingest_node({.service = "ingest"}, bus);
  std::vector<Running> running;

  ingest::IngestOptions source_options;
  source_options.log = options.log;
  source_options.asl = options.asl;
  Repeated source(source_options, options.loops);
  ingest::Validator validator;
  ingest::Compass compass = ingest::Compass::load(options.config);
  ingest_node.health().set_state(Health::State::kOk);

  const auto start = [&](const std::string& name, const Running::Start& make) {
    running.push_back({.name = name, .start = make});
    running.back().restart(bus);
  };
  if (!options.memory.empty()) std::filesystem::create_directories(options.memory);
  const auto memory_of = [&](const char* service) {
    return options.memory.empty() ? std::filesystem::path() : options.memory / service;
  };
  if (!options.map.empty()) {
    start("map_server", [&](Node& node) {
      return std::make_unique<map_server::MapServerService>(node, options.config, options.map);
    });
    start("registration",
          [&](Node& node) { return std::make_unique<registration::RegistrationService>(node, options.config); });
  }
  start("vio", [&](Node& node) {
    if (options.asl.empty()) return std::make_unique<vio::VioService>(node, options.config, memory_of("vio"));
    const vio::VioOptions vio_options =
        options.config.empty() ? vio::VioOptions{} : vio::load_setup(options.config).options;
    return std::make_unique<vio::VioService>(node, vio::load_asl_setup(options.asl, vio_options));
  });
  if (!options.config.empty()) {
    start("fusion", [&](Node& node) {
      return std::make_unique<fusion::FusionService>(node, options.config, memory_of("fusion"));
    });
  }
  schedule(options.restarts, running);

  const auto settle = [&] {
    while (bus.handleTimeout(0) > 0) {
    }
  };
  int64_t first = 0, reported = 0;
  const auto flown = [&] { return static_cast<double>(recorder.utime - first) * 1e-6; };
  do {
    recorder.begin(options.out);
    while (const auto event = source.next()) {
      if (event->message) {
        const int64_t utime = ingest::utime_of(*event->message);
        if (first == 0) first = recorder.utime = utime;
        if (utime > recorder.utime && utime - recorder.utime < kAnHour) recorder.utime = utime;
        ingest_node.advance(recorder.utime);
        for (Running& service : running) service.advance(bus, recorder.utime, flown());
        settle();
      }
      ingest::publish_checked(ingest_node, validator, compass, *event);
      settle();
      if (options.progress && recorder.utime - reported >= 1'000'000) {
        reported = recorder.utime;
        options.progress(source.progress());
      }
    }
    if (options.landed) options.landed(landings.land(flown()));
  } while (source.next_flight());
  return {flown(), recorder.messages};
}

}  // namespace orthonav::replay
