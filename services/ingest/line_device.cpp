#include "services/ingest/line_device.h"

#include <array>
#include <cerrno>
#include <cstring>
#include <map>
#include <stdexcept>

#include <arpa/inet.h>
#include <fcntl.h>
#include <fmt/format.h>
#include <poll.h>
#include <sys/socket.h>
#include <termios.h>
#include <unistd.h>

namespace orthonav::ingest {

namespace {

constexpr const char* kUdp = "udp://";

speed_t speed_of(int baud) {
  static const std::map<int, speed_t> kSpeeds{{9600, B9600},     {19200, B19200},   {38400, B38400},
                                              {57600, B57600},   {115200, B115200}, {230400, B230400},
                                              {460800, B460800}, {921600, B921600}, {1000000, B1000000}};
  const auto it = kSpeeds.find(baud);
  if (it == kSpeeds.end()) throw std::runtime_error(fmt::format("{} baud is no usual rate of a serial port", baud));
  return it->second;
}

}  // namespace

LineDevice::LineDevice(LineOptions options, const HostClock& clock)
    : options_(std::move(options)), clock_(clock), lines_(options_.port, options_.utc) {}

LineDevice::~LineDevice() {
  close();
}

void LineDevice::close() {
  if (fd_ >= 0) ::close(fd_);
  fd_ = -1;
}

void LineDevice::open() {
  close();
  lines_.restart();
  if (options_.port.starts_with(kUdp)) {
    open_udp();
  } else {
    open_serial();
  }
}

void LineDevice::open_serial() {
  fd_ = ::open(options_.port.c_str(), O_RDONLY | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
  if (fd_ < 0) throw std::runtime_error(fmt::format("{}: {}", options_.port, std::strerror(errno)));
  termios line{};
  if (tcgetattr(fd_, &line) != 0) throw std::runtime_error(options_.port + ": is no serial port");
  cfmakeraw(&line);
  line.c_cflag |= CLOCAL | CREAD;
  line.c_cflag &= ~static_cast<tcflag_t>(CSTOPB | CRTSCTS);
  cfsetispeed(&line, speed_of(options_.baud));
  cfsetospeed(&line, speed_of(options_.baud));
  if (tcsetattr(fd_, TCSANOW, &line) != 0)
    throw std::runtime_error(fmt::format("{}: does not do {} baud", options_.port, options_.baud));
  // What has piled up would seem to have been measured just now.
  tcflush(fd_, TCIFLUSH);
}

void LineDevice::open_udp() {
  const std::string address = options_.port.substr(std::strlen(kUdp));
  const size_t colon = address.rfind(':');
  sockaddr_in to{};
  to.sin_family = AF_INET;
  const int port = colon == std::string::npos ? 0 : std::atoi(address.c_str() + colon + 1);
  if (port <= 0 || port > 65535 || inet_pton(AF_INET, address.substr(0, colon).c_str(), &to.sin_addr) != 1)
    throw std::runtime_error(options_.port +
                             ": is not of the form udp://ADDRESS:PORT, with an IPv4 address of this board");
  to.sin_port = htons(static_cast<uint16_t>(port));
  fd_ = socket(AF_INET, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
  if (fd_ < 0 || bind(fd_, reinterpret_cast<const sockaddr*>(&to), sizeof(to)) != 0)
    throw std::runtime_error(fmt::format("{}: {}", options_.port, std::strerror(errno)));
}

bool LineDevice::read(std::chrono::milliseconds patience, std::vector<SensorEvent>& events) {
  pollfd ready{fd_, POLLIN, 0};
  if (poll(&ready, 1, static_cast<int>(patience.count())) == 0) return true;
  std::array<char, 4096> bytes{};
  const ssize_t count = ::read(fd_, bytes.data(), bytes.size());
  if (count < 0 && (errno == EAGAIN || errno == EINTR)) return true;
  // A datagram may be empty; a serial port that says nothing when it is ready has been pulled out.
  const bool gone = count < 0 || (count == 0 && !options_.port.starts_with(kUdp));
  if (gone) {
    throw std::runtime_error(
        fmt::format("{}: {}", options_.port, count == 0 ? "the port has gone" : std::strerror(errno)));
  }
  lines_.feed({bytes.data(), static_cast<size_t>(count)}, clock_.now(), events);
  return true;
}

}  // namespace orthonav::ingest
