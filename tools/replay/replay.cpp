#include "tools/replay/replay.h"

#include <algorithm>
#include <memory>
#include <vector>

#include <lcm/lcm-cpp.hpp>

#include "common/bus/node.h"
#include "common/flightlog/flightlog.h"
#include "services/fusion/fusion_service.h"
#include "services/ingest/ingest_service.h"
#include "services/map_server/map_server_service.h"
#include "services/registration/registration_service.h"
#include "services/vio/vio_service.h"

namespace orthonav::replay {

namespace {

// Writes everything on the bus, stamped with the data's time.
class Recorder {
 public:
  Recorder(lcm::LCM& bus, const std::filesystem::path& file) : writer_(file) {
    bus.subscribe(".*", &Recorder::record, this)->setQueueCapacity(0);
  }

  int64_t utime = 0;
  int64_t messages = 0;

 private:
  void record(const lcm::ReceiveBuffer* buffer, const std::string& channel) {
    writer_.write(utime, channel, buffer->data, buffer->data_size);
    ++messages;
  }

  LogWriter writer_;
};

}  // namespace

ReplaySummary replay(const ReplayOptions& options) {
  lcm::LCM bus("memq://");
  Recorder recorder(bus, options.out);
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
  services.push_back(std::make_unique<vio::VioService>(node("vio"), options.config));
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
