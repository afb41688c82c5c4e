#include "common/flightlog/flightlog.h"

#include <cerrno>
#include <cstdio>
#include <cstring>
#include <stdexcept>

#include <fmt/format.h>
#include <lcm/lcm.h>

namespace orthonav {

namespace {
// Size of an event's header in the file: magic, number, time, two lengths.
constexpr int64_t kHeaderBytes = 28;
}  // namespace

struct LogReader::Impl {
  lcm_eventlog_t* log = nullptr;
  int64_t size = 0;
  int64_t skipped = 0;

  ~Impl() {
    if (log != nullptr) lcm_eventlog_destroy(log);
  }
};

LogReader::LogReader(const std::filesystem::path& file) : impl_(std::make_unique<Impl>()) {
  std::error_code error;
  impl_->size = static_cast<int64_t>(std::filesystem::file_size(file, error));
  impl_->log = error ? nullptr : lcm_eventlog_create(file.c_str(), "r");
  if (impl_->log == nullptr) {
    throw std::runtime_error(fmt::format("{}: cannot open the log: {}", file.string(), std::strerror(errno)));
  }
}

LogReader::~LogReader() = default;

std::optional<LogEvent> LogReader::next() {
  for (;;) {
    const int64_t before = std::ftell(impl_->log->f);
    lcm_eventlog_event_t* event = lcm_eventlog_read_next_event(impl_->log);
    const int64_t after = std::ftell(impl_->log->f);
    if (event == nullptr) {
      // LCM gives up on an event with an impossible length; the next one may be sound.
      if (after > before && after < impl_->size) {
        impl_->skipped += after - before;
        continue;
      }
      impl_->skipped += after - before;
      return std::nullopt;
    }
    impl_->skipped += after - before - (kHeaderBytes + event->channellen + event->datalen);
    LogEvent result;
    result.utime = event->timestamp;
    result.channel.assign(event->channel, static_cast<size_t>(event->channellen));
    const auto* bytes = static_cast<const uint8_t*>(event->data);
    result.data.assign(bytes, bytes + event->datalen);
    lcm_eventlog_free_event(event);
    return result;
  }
}

int64_t LogReader::skipped_bytes() const {
  return impl_->skipped;
}

double LogReader::progress() const {
  return impl_->size > 0 ? static_cast<double>(std::ftell(impl_->log->f)) / static_cast<double>(impl_->size) : 1.0;
}

struct LogWriter::Impl {
  std::filesystem::path file;
  lcm_eventlog_t* log = nullptr;

  ~Impl() {
    if (log != nullptr) lcm_eventlog_destroy(log);
  }
};

LogWriter::LogWriter(const std::filesystem::path& file) : impl_(std::make_unique<Impl>()) {
  impl_->file = file;
  impl_->log = lcm_eventlog_create(file.c_str(), "w");
  if (impl_->log == nullptr) {
    throw std::runtime_error(fmt::format("{}: cannot create the log: {}", file.string(), std::strerror(errno)));
  }
}

LogWriter::~LogWriter() = default;

void LogWriter::write(int64_t utime, const std::string& channel, const void* data, size_t size) {
  lcm_eventlog_event_t event{};
  event.timestamp = utime;
  event.channellen = static_cast<int32_t>(channel.size());
  event.datalen = static_cast<int32_t>(size);
  // The C interface is not const-correct; it only reads.
  event.channel = const_cast<char*>(channel.c_str());
  event.data = const_cast<void*>(data);
  if (lcm_eventlog_write_event(impl_->log, &event) != 0) {
    throw std::runtime_error(
        fmt::format("{}: cannot write to the log: {}", impl_->file.string(), std::strerror(errno)));
  }
}

}  // namespace orthonav
