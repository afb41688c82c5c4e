#include "services/ingest/sensor_watch.h"

#include <algorithm>
#include <cmath>
#include <string_view>
#include <vector>

#include <fmt/format.h>

namespace orthonav::ingest {

namespace {

// Over which messages are counted: microseconds, and as a multiple of the silence that is no fault.
constexpr int64_t kShortestWindow = 800'000;
constexpr double kWindowOfSilence = 1.6;
constexpr double kTolerableRefusals = 0.1;  // of the messages in the window
// For how long, in microseconds, and in how many readings a sensor may say the very same: reported within a second.
constexpr int64_t kFrozenImu = 300'000, kFrozenCamera = 800'000, kFrozenCompass = 500'000;
constexpr int kFrozenSamples = 10, kFrozenImages = 4, kFrozenHeadings = 4;
// A turn that no compass can miss, rad, within a time in which few gyroscopes' biases make it (10 degrees/s).
constexpr double kSeenTurn = 0.35;
constexpr int64_t kTurnTime = 2'000'000;
// A sensor is slow below so much of its usual rate, and no longer slow above so much of it. The usual one is the median
// of so many windows; of fewer messages in each than kFewestUsual, silence says enough.
constexpr double kSlow = 0.4, kNotSlow = 0.5;
constexpr size_t kUsualWindows = 25, kFewestWindows = 5, kFewestUsual = 4;
constexpr int64_t kPause = 300'000;  // after which it may be about to fall silent, which is another fault

std::string_view bytes_of(const void* data, size_t size) {
  return {static_cast<const char*>(data), size};
}

struct Reading {
  size_t hash;
  int64_t longest;    // microseconds for which it may stay the same; 0: for ever
  int most;           // readings that may be the same
  bool until_a_turn;  // it may for ever while the board does not turn
};

// A compass at rest may well repeat itself; an IMU and a camera have noise in their last digits.
Reading reading_of(const SensorMessage& message) {
  const std::hash<std::string_view> hash;
  if (const auto* imu = std::get_if<imu_t>(&message)) {
    return {hash(bytes_of(imu->angular_rate, sizeof(imu->angular_rate))) * 31 +
                hash(bytes_of(imu->specific_force, sizeof(imu->specific_force))),
            kFrozenImu, kFrozenSamples, false};
  }
  if (const auto* image = std::get_if<image_t>(&message))
    return {hash(bytes_of(image->data.data(), image->data.size())), kFrozenCamera, kFrozenImages, false};
  if (const auto* magnetometer = std::get_if<magnetometer_t>(&message))
    return {hash(bytes_of(magnetometer->field, sizeof(magnetometer->field))), kFrozenCompass, kFrozenHeadings, true};
  if (const auto* compass = std::get_if<compass_t>(&message))
    return {hash(bytes_of(&compass->heading, sizeof(compass->heading))), kFrozenCompass, kFrozenHeadings, true};
  return {0, 0, 0, false};
}

}  // namespace

SensorWatch::SensorWatch(std::string channel, double silence)
    : channel_(std::move(channel)),
      silence_(silence),
      window_(std::max(kShortestWindow, int64_t{std::llround(kWindowOfSilence * 1e6 * silence)})) {}

bool SensorWatch::frozen(const SensorMessage& message, int64_t now, double yaw) {
  const Reading reading = reading_of(message);
  if (reading.longest == 0) return false;
  if (same_count_ == 0 || reading.hash != reading_) {
    reading_ = reading.hash;
    same_since_ = yaw_time_ = now;
    yaw_ = yaw;
    same_count_ = 0;
    turned_ = frozen_ = false;
  }
  ++same_count_;
  if (now - yaw_time_ > kTurnTime) {
    yaw_time_ = now;
    yaw_ = yaw;
  }
  turned_ = turned_ || std::abs(yaw - yaw_) > kSeenTurn;
  frozen_ = same_count_ >= reading.most && now - same_since_ >= reading.longest && (turned_ || !reading.until_a_turn);
  return frozen_;
}

void SensorWatch::forget_turn(int64_t now, double yaw) {
  yaw_time_ = now;
  yaw_ = yaw;
  turned_ = false;
}

void SensorWatch::judged(const SensorMessage& message, const std::string& fault, int64_t now) {
  recent_.push_back({now, !fault.empty()});
  while (now - recent_.front().time > window_) recent_.pop_front();
  if (!fault.empty()) {
    last_fault_ = fault;
    return;
  }
  last_good_ = now;
  ever_good_ = true;
  if (const auto* imu = std::get_if<imu_t>(&message)) imu_.feed(*imu, now);
}

std::string SensorWatch::complaint(int64_t now) {
  if (last_good_ == 0) last_good_ = now;
  while (!recent_.empty() && now - recent_.front().time > window_) recent_.pop_front();
  const auto refused = std::count_if(recent_.begin(), recent_.end(), [](const auto& j) { return j.refused; });
  std::vector<std::string> faults;
  const double tolerable = frozen_ ? 0 : kTolerableRefusals * static_cast<double>(recent_.size());
  if (static_cast<double>(refused) > tolerable) {
    faults.push_back(fmt::format("{} of {} messages of the last {} ms refused: {}", refused, recent_.size(),
                                 window_ / 1000, last_fault_));
  }
  const double silent = static_cast<double>(now - last_good_) * 1e-6;
  if (silent > silence_) {
    faults.push_back(ever_good_ ? fmt::format("silent for {:.1f} s", silent)
                                : fmt::format("nothing has come for {:.1f} s", silent));
  } else {
    faults.push_back(slowness(recent_.size() - static_cast<size_t>(refused), now));
  }
  faults.push_back(imu_.complaint(now));
  std::erase(faults, "");
  return faults.empty() ? "" : fmt::format("{}: {}", channel_, fmt::join(faults, ", "));
}

// The rate now, against that of the sensor's own last twenty seconds in which it was not slow.
std::string SensorWatch::slowness(size_t good, int64_t now) {
  if (counts_.size() >= kFewestWindows) {
    std::vector<size_t> sorted(counts_.begin(), counts_.end());
    const auto middle = sorted.begin() + static_cast<std::ptrdiff_t>(sorted.size() / 2);
    std::nth_element(sorted.begin(), middle, sorted.end());
    const auto usual = static_cast<double>(*middle), share = static_cast<double>(good) / std::max(usual, 1.0);
    if (*middle < kFewestUsual || share > kNotSlow) {
      slow_ = false;
    } else if (share < kSlow && now - last_good_ < kPause) {
      slow_ = true;
    }
    if (slow_) {
      const auto rate = [this](double count) { return count * 1e6 / static_cast<double>(window_); };
      return fmt::format("{:.0f} messages a second, where there were {:.0f}", rate(static_cast<double>(good)),
                         rate(usual));
    }
  }
  if (now - counted_ >= window_) {
    counted_ = now;
    counts_.push_back(good);
    if (counts_.size() > kUsualWindows) counts_.pop_front();
  }
  return {};
}

}  // namespace orthonav::ingest
