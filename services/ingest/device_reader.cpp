#include "services/ingest/device_reader.h"

#include <algorithm>
#include <iterator>

namespace orthonav::ingest {

namespace {

constexpr std::chrono::milliseconds kPatience{50};
constexpr std::chrono::milliseconds kPause{200};  // before a device that failed is opened again
// Nobody takes them any more than so many late; then the newest are given up, and memory stays bounded.
constexpr size_t kMostWaiting = 5000;

}  // namespace

DeviceReader::DeviceReader(std::unique_ptr<Device> device)
    : device_(std::move(device)), name_(device_->name()), channels_(device_->channels()), thread_([this] { run(); }) {}

DeviceReader::~DeviceReader() {
  {
    const std::lock_guard lock(mutex_);
    stopping_ = true;
  }
  stop_.notify_all();
  thread_.join();
}

void DeviceReader::take(std::vector<SensorEvent>& events) {
  const std::lock_guard lock(mutex_);
  std::move(events_.begin(), events_.end(), std::back_inserter(events));
  events_.clear();
}

std::string DeviceReader::trouble() const {
  const std::lock_guard lock(mutex_);
  return trouble_;
}

bool DeviceReader::ended() const {
  const std::lock_guard lock(mutex_);
  return ended_ && events_.empty();
}

void DeviceReader::run() {
  while (!stopping_) {
    try {
      read_until_it_fails();
    } catch (const std::exception& error) {
      std::unique_lock lock(mutex_);
      trouble_ = error.what();
      stop_.wait_for(lock, kPause, [this] { return stopping_.load(); });
      continue;
    }
    const std::lock_guard lock(mutex_);
    ended_ = true;
    return;
  }
}

void DeviceReader::read_until_it_fails() {
  device_->open();
  {
    const std::lock_guard lock(mutex_);
    trouble_.clear();
  }
  std::vector<SensorEvent> read;
  bool more = true;
  while (more && !stopping_) {
    read.clear();
    more = device_->read(kPatience, read);
    const std::lock_guard lock(mutex_);
    const size_t room = kMostWaiting - std::min(events_.size(), kMostWaiting);
    const auto end = read.begin() + static_cast<std::ptrdiff_t>(std::min(room, read.size()));
    std::move(read.begin(), end, std::back_inserter(events_));
  }
}

}  // namespace orthonav::ingest
