#include "services/ingest/sensor_service.h"

#include <algorithm>
#include <cmath>
#include <string>

#include <fmt/format.h>
#include <spdlog/spdlog.h>

#include "common/bus/channels.h"
#include "common/bus/wording.h"
#include "services/ingest/ingest_service.h"
#include "services/ingest/sensor_options.h"

namespace orthonav::ingest {

namespace {

constexpr std::chrono::milliseconds kPublishPeriod{1};
constexpr std::chrono::milliseconds kWatchPeriod{100};
// Seconds: a camera behind a network is some late, and no sensor is early but by what its clock was set by.
constexpr double kLatest = 5, kEarliest = 0.1;
// A turn is known from samples that are no further apart, s, and no faster, rad/s.
constexpr double kLongestStep = 0.1, kFastestTurn = 10;

// What is wrong with a stamp that comes now; empty when it may be right. In doubles, for a stamp may be anything.
std::string clock_fault(int64_t utime, int64_t now) {
  const double late = 1e-6 * (static_cast<double>(now) - static_cast<double>(utime));
  if (late <= kLatest && late >= -kEarliest) return {};
  return fmt::format("stamped {:.1f} s {} this board's clock (as it was when ingest was started)", std::abs(late),
                     late > 0 ? "behind" : "ahead of");
}

}  // namespace

SensorService::SensorService(Node& node, const std::filesystem::path& config)
    : node_(node), compass_(Compass::load(config)) {
  const SensorOptions options = SensorOptions::load(config);
  for (auto& device : make_devices(options, clock_)) {
    readers_.push_back(std::make_unique<DeviceReader>(std::move(device)));
    for (const std::string& channel : readers_.back()->channels())
      watches_.try_emplace(channel, channel, options.silence_s);
  }
  node.every(kPublishPeriod, [this] { publish_what_came(); });
  node.every(kWatchPeriod, [this] { watch(); });
}

void SensorService::publish_what_came() {
  const bool ended = std::all_of(readers_.begin(), readers_.end(), [](const auto& r) { return r->ended(); });
  events_.clear();
  for (const auto& reader : readers_) reader->take(events_);
  const int64_t now = clock_.now();
  for (const SensorEvent& event : events_) {
    std::string fault;
    const auto found = event.message ? watches_.find(channel_of(*event.message)) : watches_.end();
    if (found == watches_.end()) {
      publish_checked(node_, validator_, compass_, event);
    } else if (fault = clock_fault(utime_of(*event.message), now); !fault.empty()) {
      node_.health().add("rejected." + found->first + ".clock");
      found->second.judged(*event.message, fault, now);
    } else if (found->second.frozen(*event.message, now, yaw_)) {
      node_.health().add("rejected." + found->first + ".frozen");
      found->second.judged(*event.message, "the very same reading again and again", now);
    } else {
      fault = publish_checked(node_, validator_, compass_, event);
      found->second.judged(*event.message, fault, now);
      if (const auto* imu = std::get_if<imu_t>(&*event.message); imu != nullptr && fault.empty()) turn(*imu);
    }
  }
  if (ended) node_.stop();
}

void SensorService::turn(const imu_t& imu) {
  const double elapsed = 1e-6 * static_cast<double>(imu.utime - imu_utime_);
  if (elapsed > 0 && elapsed < kLongestStep && std::abs(imu.angular_rate[2]) < kFastestTurn)
    yaw_ += elapsed * imu.angular_rate[2];
  imu_utime_ = imu.utime;
}

void SensorService::watch() {
  std::string complaint;
  bool imu_is_sound = true;
  const int64_t now = clock_.now();
  for (const auto& reader : readers_) {
    if (reader->ended()) continue;
    std::string wrong;
    for (const std::string& channel : reader->channels()) {
      node_.health().set("rate_hz." + channel, validator_.rate_hz(channel));
      const std::string fault = watches_.at(channel).complaint(now);
      if (fault.empty()) continue;
      if (channel == channel::kImu) imu_is_sound = false;
      wrong += (wrong.empty() ? "" : ", ") + fault;
    }
    if (wrong.empty()) continue;
    const std::string trouble = reader->trouble();
    complaint +=
        fmt::format("{}{} ({})", complaint.empty() ? "" : "; ", wrong, trouble.empty() ? reader->name() : trouble);
  }
  if (!imu_is_sound)
    for (auto& [channel, watch] : watches_) watch.forget_turn(now, yaw_);
  const std::string words = wording(complaint);
  if (words != words_) {
    if (complaint.empty()) {
      spdlog::info("all sensors are there");
    } else {
      spdlog::warn("{}", complaint);
    }
    if (words_.empty()) node_.health().add("sensor_outages");
    node_.health().hurry();
  }
  words_ = words;
  node_.health().set_state(complaint.empty() ? Health::State::kOk : Health::State::kDegraded, complaint);
}

}  // namespace orthonav::ingest
