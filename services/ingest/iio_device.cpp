#include "services/ingest/iio_device.h"

#include <algorithm>
#include <cerrno>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <limits>
#include <stdexcept>

#include <fcntl.h>
#include <fmt/format.h>
#include <poll.h>
#include <unistd.h>

#include "common/bus/channels.h"

namespace orthonav::ingest {

namespace {

constexpr double kTeslaPerGauss = 1e-4;
constexpr size_t kReadAtOnce = 4096;  // bytes

const std::vector<std::string>& axes_of(IioOptions::Kind kind) {
  static const std::vector<std::string> kImu{"in_anglvel_x", "in_anglvel_y", "in_anglvel_z",
                                             "in_accel_x",   "in_accel_y",   "in_accel_z"};
  static const std::vector<std::string> kMagnetometer{"in_magn_x", "in_magn_y", "in_magn_z"};
  return kind == IioOptions::Kind::kImu ? kImu : kMagnetometer;
}

// Writes a sysfs attribute unless it says so already: what udev or a privileged start has set up needs no rights.
void ensure(const std::filesystem::path& file, const std::string& value) {
  std::string now;
  std::ifstream(file) >> now;
  if (now == value) return;
  std::ofstream stream(file);
  stream << value << std::flush;
  if (!stream) {
    throw std::runtime_error(fmt::format(
        "{}: '{}' cannot be written: run orthonav-ingest --prepare-sensors as root first", file.string(), value));
  }
}

}  // namespace

IioDevice::IioDevice(IioOptions options, const HostClock& clock) : options_(std::move(options)), clock_(clock) {}

IioDevice::~IioDevice() {
  close();
}

std::string IioDevice::name() const {
  return fmt::format("IIO device {}", options_.device);
}

std::vector<std::string> IioDevice::channels() const {
  return {options_.kind == IioOptions::Kind::kImu ? channel::kImu : channel::kMagnetometer};
}

std::filesystem::path IioDevice::find() const {
  std::error_code error;
  std::string others;
  for (const auto& entry : std::filesystem::directory_iterator(options_.sysfs, error)) {
    if (!std::filesystem::exists(entry.path() / "name")) continue;
    const std::string name = read_line(entry.path() / "name");
    if (name == options_.device || entry.path().filename() == options_.device) return entry.path();
    others += " " + name;
  }
  throw std::runtime_error(fmt::format("{}: there is no device '{}'; there are:{}", options_.sysfs.string(),
                                       options_.device, others.empty() ? " none" : others));
}

void IioDevice::set_up() {
  folder_ = find();
  std::vector<std::string> wanted = axes_of(options_.kind);
  wanted.emplace_back("in_timestamp");
  channels_.clear();
  for (const std::string& name : wanted) channels_.push_back(read_channel(folder_, name));
  record_length_ = lay_out(channels_);
  for (size_t i = 0; i < wanted.size(); ++i) {
    const auto it =
        std::find_if(channels_.begin(), channels_.end(), [&](const IioChannel& c) { return c.name == wanted[i]; });
    order_[i] = static_cast<size_t>(it - channels_.begin());
  }

  // Only what is enabled is in the record, so everything else has to go; and nothing may change while the buffer runs.
  const auto elements = folder_ / "scan_elements";
  bool changed = false;
  for (const auto& entry : std::filesystem::directory_iterator(elements)) {
    const std::string file = entry.path().filename();
    if (!file.ends_with("_en")) continue;
    const bool want = std::find(wanted.begin(), wanted.end(), file.substr(0, file.size() - 3)) != wanted.end();
    changed = changed || read_line(entry.path()) != (want ? "1" : "0");
  }
  const auto enable = folder_ / "buffer" / "enable";
  if (changed) ensure(enable, "0");
  for (const auto& entry : std::filesystem::directory_iterator(elements)) {
    const std::string file = entry.path().filename();
    if (!file.ends_with("_en")) continue;
    const bool want = std::find(wanted.begin(), wanted.end(), file.substr(0, file.size() - 3)) != wanted.end();
    if (changed) ensure(entry.path(), want ? "1" : "0");
  }
  if (changed) ensure(folder_ / "buffer" / "length", std::to_string(options_.buffer_length));
  for (const char* file : {"sampling_frequency", "in_anglvel_sampling_frequency", "in_accel_sampling_frequency",
                           "in_magn_sampling_frequency"}) {
    if (options_.rate_hz > 0 && std::filesystem::exists(folder_ / file) &&
        std::atof(read_line(folder_ / file).c_str()) != options_.rate_hz) {
      ensure(folder_ / file, fmt::format("{}", options_.rate_hz));
    }
  }
  const auto stamps = folder_ / "current_timestamp_clock";
  const std::string clock = std::filesystem::exists(stamps) ? read_line(stamps) : "realtime";
  monotonic_ = clock == "monotonic" || clock == "monotonic_coarse";
  if (!monotonic_ && !clock.starts_with("realtime")) {
    throw std::runtime_error(
        fmt::format("{}: stamps by '{}', which says nothing here: write monotonic into it", stamps.string(), clock));
  }
  ensure(enable, "1");
}

void IioDevice::open() {
  close();
  set_up();
  const auto file = options_.dev / folder_.filename();
  fd_ = ::open(file.c_str(), O_RDONLY | O_NONBLOCK | O_CLOEXEC);
  if (fd_ < 0) throw std::runtime_error(fmt::format("{}: {}", file.string(), std::strerror(errno)));
  rest_.clear();
}

void IioDevice::close() {
  if (fd_ >= 0) ::close(fd_);
  fd_ = -1;
}

bool IioDevice::read(std::chrono::milliseconds patience, std::vector<SensorEvent>& events) {
  pollfd ready{fd_, POLLIN, 0};
  if (poll(&ready, 1, static_cast<int>(patience.count())) == 0) return true;
  const size_t had = rest_.size();
  rest_.resize(had + kReadAtOnce);
  const ssize_t count = ::read(fd_, rest_.data() + had, kReadAtOnce);
  const int error = errno;
  rest_.resize(had + static_cast<size_t>(std::max<ssize_t>(count, 0)));
  if (count < 0 && (error == EAGAIN || error == EINTR)) return true;
  if (count <= 0) {
    throw std::runtime_error(
        fmt::format("{}: {}", folder_.string(), count == 0 ? "the device has gone" : std::strerror(error)));
  }
  size_t at = 0;
  for (; at + record_length_ <= rest_.size(); at += record_length_) events.push_back(event_of(rest_.data() + at));
  rest_.erase(rest_.begin(), rest_.begin() + static_cast<std::ptrdiff_t>(at));
  return true;
}

SensorEvent IioDevice::event_of(const uint8_t* record) const {
  const auto raw = [&](size_t i) {
    const IioChannel& c = channels_[order_[i]];
    return c.type.decode(record + c.position);
  };
  // One axis of a triple, in the body's frame.
  const auto axis = [&](size_t triple, size_t row, double unit) {
    double sum = 0;
    for (size_t i = 0; i < 3; ++i) {
      const IioChannel& c = channels_[order_[3 * triple + i]];
      sum += options_.R_B_S[3 * row + i] * (static_cast<double>(raw(3 * triple + i)) + c.offset) * c.scale;
    }
    return sum * unit;
  };
  const int64_t stamp = raw(axes_of(options_.kind).size());
  const int64_t utime = monotonic_ ? clock_.of_monotonic(stamp) : clock_.of_realtime(stamp);
  if (options_.kind == IioOptions::Kind::kMagnetometer) {
    magnetometer_t m{};
    m.utime = utime;
    for (size_t i = 0; i < 3; ++i) m.field[i] = axis(0, i, kTeslaPerGauss);
    return {SensorMessage(m), ""};
  }
  imu_t m{};
  m.utime = utime;
  for (size_t i = 0; i < 3; ++i) {
    m.angular_rate[i] = axis(0, i, 1);
    m.specific_force[i] = axis(1, i, 1);
  }
  m.temperature_deg_c = std::numeric_limits<float>::quiet_NaN();
  return {SensorMessage(m), ""};
}

}  // namespace orthonav::ingest
