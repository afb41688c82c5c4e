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

}  // namespace

ReplaySummary replay(const ReplayOptions& options) {
  lcm::LCM bus("memq://");
  Recorder recorder(bus, options.out);
  OdometryText text(bus, options.trajectory, options.times);
  std::vector<std::unique_ptr<Node>> nodes;
  const auto node = [&](const char* service) -> Node& {
    nodes.push_back(std::make_unique<Node>(NodeOptions{.service = service}, bus));
    return *nodes.back();
  };

  ingest::IngestOptions source_options;
  source_options.log = options.log;
  source_options.asl = options.asl;
  const auto source = ingest::make_source(source_options);
  ingest::Validator validator;
  ingest::Compass compass = ingest::Compass::load(options.config);
  Node& ingest_node = node("ingest");
  ingest_node.health().set_state(Health::State::kOk);

  std::vector<std::unique_ptr<Service>> services;
  if (!options.map.empty()) {
    services.push_back(std::make_unique<map_server::MapServerService>(node("map_server"), options.config, options.map));
    services.push_back(std::make_unique<registration::RegistrationService>(node("registration"), options.config));
  }
  if (options.asl.empty()) {
    services.push_back(std::make_unique<vio::VioService>(node("vio"), options.config));
  } else {
    const vio::VioOptions vio_options =
        options.config.empty() ? vio::VioOptions{} : vio::load_setup(options.config).options;
    services.push_back(std::make_unique<vio::VioService>(node("vio"), vio::load_asl_setup(options.asl, vio_options)));
  }
  if (!options.config.empty())
    services.push_back(std::make_unique<fusion::FusionService>(node("fusion"), options.config));

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
      for (const auto& n : nodes) n->advance(recorder.utime);
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
