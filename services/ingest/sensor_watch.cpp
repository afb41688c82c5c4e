#include "services/ingest/sensor_watch.h"

#include <algorithm>
#include <string_view>

#include <fmt/format.h>

namespace orthonav::ingest {

namespace {

constexpr int64_t kWindow = 500'000;        // microseconds over which refusals are counted
constexpr double kTolerableRefusals = 0.1;  // of the messages in the window
// For how long, in microseconds, and in how many readings a sensor may say the very same: reported within a second.
constexpr int64_t kFrozenImu = 300'000, kFrozenCamera = 800'000;
constexpr int kFrozenSamples = 10, kFrozenImages = 4;

std::string_view bytes_of(const void* data, size_t size) {
  return {static_cast<const char*>(data), size};
}

struct Reading {
  size_t hash;
  int64_t longest;  // microseconds for which it may stay the same; 0: for ever
  int most;         // readings that may be the same
};

// A compass at rest may well repeat itself, so only what has noise in its last digits is judged.
Reading reading_of(const SensorMessage& message) {
  const std::hash<std::string_view> hash;
  if (const auto* imu = std::get_if<imu_t>(&message)) {
    return {hash(bytes_of(imu->angular_rate, sizeof(imu->angular_rate))) * 31 +
                hash(bytes_of(imu->specific_force, sizeof(imu->specific_force))),
            kFrozenImu, kFrozenSamples};
  }
  if (const auto* image = std::get_if<image_t>(&message))
    return {hash(bytes_of(image->data.data(), image->data.size())), kFrozenCamera, kFrozenImages};
  return {0, 0, 0};
}

}  // namespace

bool SensorWatch::frozen(const SensorMessage& message, int64_t now) {
  const Reading reading = reading_of(message);
  if (reading.longest == 0) return false;
  if (same_count_ == 0 || reading.hash != reading_) {
    reading_ = reading.hash;
    same_since_ = now;
    same_count_ = 0;
  }
  ++same_count_;
  return same_count_ >= reading.most && now - same_since_ >= reading.longest;
}

void SensorWatch::judged(const std::string& fault, int64_t now) {
  recent_.push_back({now, !fault.empty()});
  while (now - recent_.front().time > kWindow) recent_.pop_front();
  if (!fault.empty()) {
    last_fault_ = fault;
    return;
  }
  last_good_ = now;
  ever_good_ = true;
}

std::string SensorWatch::complaint(int64_t now) {
  if (last_good_ == 0) last_good_ = now;
  while (!recent_.empty() && now - recent_.front().time > kWindow) recent_.pop_front();
  const auto refused = std::count_if(recent_.begin(), recent_.end(), [](const auto& j) { return j.refused; });
  if (refused > 0 && static_cast<double>(refused) > kTolerableRefusals * static_cast<double>(recent_.size())) {
    return fmt::format("{}: {} of {} messages of the last {} ms refused: {}", channel_, refused, recent_.size(),
                       kWindow / 1000, last_fault_);
  }
  const double silent = static_cast<double>(now - last_good_) * 1e-6;
  if (silent <= silence_) return "";
  return ever_good_ ? fmt::format("{}: silent for {:.1f} s", channel_, silent)
                    : fmt::format("{}: nothing has come for {:.1f} s", channel_, silent);
}

}  // namespace orthonav::ingest
