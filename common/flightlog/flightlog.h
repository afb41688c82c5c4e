// Reading and writing LCM logs (the format of lcm-logger and lcm-logplayer).
#pragma once

#include <cstdint>
#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <vector>

namespace orthonav {

struct LogEvent {
  int64_t utime = 0;  // microseconds since the Unix epoch: when it was logged
  std::string channel;
  std::vector<uint8_t> data;

  // The message, if it decodes as Msg.
  template <class Msg>
  std::optional<Msg> decode() const {
    Msg message;
    if (message.decode(data.data(), 0, static_cast<int>(data.size())) < 0) return std::nullopt;
    return message;
  }
};

// Reads events in the order of the file. A damaged stretch is skipped to the next sound
// event and counted, with the event before it.
class LogReader {
 public:
  // Throws std::runtime_error naming the file when it cannot be opened.
  explicit LogReader(const std::filesystem::path& file);
  ~LogReader();

  // The next event, or nullopt at the end.
  std::optional<LogEvent> next();
  // Bytes skipped because they were no event, so far.
  int64_t skipped_bytes() const;
  // Position in the file, 0..1, for progress.
  double progress() const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

class LogWriter {
 public:
  // Throws std::runtime_error naming the file when it cannot be created.
  explicit LogWriter(const std::filesystem::path& file);
  ~LogWriter();

  // Throws std::runtime_error naming the file when the disk is full.
  void write(int64_t utime, const std::string& channel, const void* data, size_t size);

  template <class Msg>
  void write(int64_t utime, const std::string& channel, const Msg& message) {
    std::vector<uint8_t> buffer(static_cast<size_t>(message.getEncodedSize()));
    message.encode(buffer.data(), 0, static_cast<int>(buffer.size()));
    write(utime, channel, buffer.data(), buffer.size());
  }

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace orthonav
