#include "tools/replay/replay.h"

#include <algorithm>
#include <fstream>
#include <memory>
#include <optional>
#include <stdexcept>
#include <vector>

#include <fmt/format.h>
#include <lcm/lcm-cpp.hpp>

#include "common/bus/channels.h"
#include "common/bus/node.h"
#include "common/flightlog/flightlog.h"
#include "orthonav/vio_state_t.hpp"
#include "services/fusion/fusion_service.h"
#include "services/ingest/ingest_service.h"
#include "services/map_server/map_server_service.h"
#include "services/registration/registration_service.h"
#include "services/vio/asl_setup.h"
#include "services/vio/vio_service.h"

namespace orthonav::replay {

namespace {

// Writes everything on the bus, stamped with the data's time.
class Recorder {
 public:
  Recorder(lcm::LCM& bus, const std::filesystem::path& file) {
    if (!file.empty()) writer_.emplace(file);
    bus.subscribe(".*", &Recorder::record, this)->setQueueCapacity(0);
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
  Recorder recorder(bus, options.out);
  OdometryText text(bus, options.trajectory, options.times);
  Node ingest_node({.service = "ingest"}, bus);
  std::vector<Running> running;

  ingest::IngestOptions source_options;
  source_options.log = options.log;
  source_options.asl = options.asl;
  const auto source = ingest::make_source(source_options);
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
  while (const auto event = source->next()) {
    if (event->message) {
      const int64_t utime = ingest::utime_of(*event->message);
      // A stamp out of order is the validator's to judge; it must not move the clock of everybody else.
      if (first == 0) first = recorder.utime = utime;
      if (utime > recorder.utime && utime - recorder.utime < 3'600'000'000) recorder.utime = utime;
      ingest_node.advance(recorder.utime);
      for (Running& service : running)
        service.advance(bus, recorder.utime, 1e-6 * static_cast<double>(recorder.utime - first));
      settle();
    }
    ingest::publish_checked(ingest_node, validator, compass, *event);
    settle();
    if (options.progress && recorder.utime - reported >= 1'000'000) {
      reported = recorder.utime;
      options.progress(source->progress());
    }
  }
  return {static_cast<double>(recorder.utime - first) * 1e-6, recorder.messages};
}

}  // namespace orthonav::replay
