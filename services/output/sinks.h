// Where sentences go: a UDP port or a serial line. A sink that cannot write says so and never blocks or throws; a
// serial device that is not there yet, or that was unplugged, is opened again by a later write.
//
// Not thread-safe.
#pragma once

#include <cstdint>
#include <memory>
#include <string>

namespace orthonav::output {

class Sink {
 public:
  virtual ~Sink() = default;
  // Sends all of the text, or returns false and says why in error().
  virtual bool write(const std::string& text) = 0;
  const std::string& error() const { return error_; }

 protected:
  std::string error_;
};

class UdpSink final : public Sink {
 public:
  // Throws std::runtime_error when the system gives no socket.
  UdpSink(const std::string& host, int port);
  ~UdpSink() override;
  UdpSink(const UdpSink&) = delete;
  UdpSink& operator=(const UdpSink&) = delete;
  bool write(const std::string& text) override;
  static bool is_address(const std::string& host);

 private:
  std::string host_;
  int port_;
  int socket_ = -1;
};

class SerialSink final : public Sink {
 public:
  SerialSink(std::string device, int baud) : device_(std::move(device)), baud_(baud) {}
  ~SerialSink() override { close(); }
  SerialSink(const SerialSink&) = delete;
  SerialSink& operator=(const SerialSink&) = delete;
  bool write(const std::string& text) override;
  static bool is_baud(int baud);

 private:
  bool open();
  void close();
  bool fail(const std::string& what);

  std::string device_;
  int baud_;
  int file_ = -1;
};

}  // namespace orthonav::output
