#include "services/ingest/ingest_service.h"

#include <cstdio>
#include <stdexcept>

#include <fmt/format.h>

#include "common/bus/channels.h"
#include "services/ingest/asl_source.h"
#include "services/ingest/log_source.h"

namespace orthonav::ingest {

std::unique_ptr<SensorSource> make_source(const IngestOptions& options) {
  if (options.log.empty() == options.asl.empty())
    throw std::runtime_error("name one source: --log FILE or --asl FOLDER, or --sensors");
  if (!options.log.empty()) return std::make_unique<LogSource>(options.log);
  return std::make_unique<AslSource>(options.asl);
}

namespace {

// Publishes a message if it is sound; else counts it and says what is wrong with it.
std::string publish_if_sound(Node& node, Validator& validator, const SensorMessage& message) {
  const std::string channel = channel_of(message);
  const Verdict verdict = validator.check(message);
  if (!verdict.accepted) {
    node.health().reject(channel + "." + verdict.reason, verdict.detail);
    return verdict.detail;
  }
  if (verdict.gap) node.health().add("gaps." + channel);
  std::visit([&](const auto& m) { node.publish(channel, m); }, message);
  return "";
}

}  // namespace

std::string publish_checked(Node& node, Validator& validator, Compass& compass, const SensorEvent& event) {
  if (!event.message) {
    node.health().reject("source", event.error);
    return event.error;
  }
  if (std::holds_alternative<compass_t>(*event.message)) compass.stand_back();
  std::string fault = publish_if_sound(node, validator, *event.message);
  if (!fault.empty()) return fault;
  if (auto heading = compass.feed(*event.message)) publish_if_sound(node, validator, SensorMessage(*heading));
  return "";
}

IngestService::IngestService(Node& node, const std::filesystem::path& config, const IngestOptions& options)
    : node_(node),
      options_(options),
      source_(make_source(options)),
      compass_(Compass::load(config)),
      awaited_(options.wait_for.begin(), options.wait_for.end()) {
  if (!(options.speed > 0)) throw std::runtime_error("--speed must be positive");
  node.subscribe<health_t>(channel::kHealth, Delivery::kAll, [this](const health_t& m) { awaited_.erase(m.service); });
  node.every(std::chrono::milliseconds(1), [this] { tick(); });
  node.every(std::chrono::seconds(1), [this] { report(); });
}

void IngestService::tick() {
  if (!awaited_.empty()) return;
  const auto now = std::chrono::steady_clock::now();
  for (;;) {
    if (!pending_) {
      pending_ = source_->next();
      if (!pending_) {
        report();
        node_.stop();
        return;
      }
    }
    if (pending_->message) {
      const int64_t utime = utime_of(*pending_->message);
      // The first message sets the clock; a stamp from before it, or from the far future, is due at once, for the
      // validator to judge.
      if (first_utime_ == 0) {
        first_utime_ = utime;
        start_ = now;
        node_.health().set_state(Health::State::kOk);
      }
      const double due = static_cast<double>(utime - first_utime_) * 1e-6 / options_.speed;
      const double since_last = static_cast<double>(utime - last_utime_) * 1e-6;
      if (std::chrono::duration<double>(now - start_).count() < due && !(last_utime_ != 0 && since_last > 3600)) return;
      if (last_utime_ == 0 || since_last <= 3600) last_utime_ = std::max(last_utime_, utime);
    }
    publish_checked(node_, validator_, compass_, *pending_);
    pending_.reset();
  }
}

void IngestService::report() {
  if (!awaited_.empty()) {
    node_.health().set_state(Health::State::kStarting,
                             fmt::format("waiting for the heartbeat of {}", *awaited_.begin()));
  }
  for (const char* channel : {channel::kImu, channel::kCamera, channel::kCompass}) {
    node_.health().set(std::string("rate_hz.") + channel, options_.speed * validator_.rate_hz(channel));
  }
  if (options_.progress && first_utime_ != 0) {
    std::fprintf(stderr, "\r  flying: %6.1f s  (%3.0f %% of the log)  ",
                 static_cast<double>(last_utime_ - first_utime_) * 1e-6, 100 * source_->progress());
  }
}

}  // namespace orthonav::ingest
