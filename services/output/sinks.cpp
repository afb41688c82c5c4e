#include "services/output/sinks.h"

#include <cerrno>
#include <cstring>
#include <optional>
#include <stdexcept>

#include <arpa/inet.h>
#include <fcntl.h>
#include <fmt/format.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <termios.h>
#include <unistd.h>

namespace orthonav::output {
namespace {

std::optional<speed_t> speed_of(int baud) {
  switch (baud) {
    case 4800:
      return B4800;
    case 9600:
      return B9600;
    case 19200:
      return B19200;
    case 38400:
      return B38400;
    case 57600:
      return B57600;
    case 115200:
      return B115200;
    case 230400:
      return B230400;
    default:
      return std::nullopt;
  }
}

}  // namespace

UdpSink::UdpSink(const std::string& host, int port)
    : host_(host), port_(port), socket_(::socket(AF_INET, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0)) {
  if (socket_ < 0) throw std::runtime_error(fmt::format("no UDP socket: {}", std::strerror(errno)));
}

UdpSink::~UdpSink() {
  ::close(socket_);
}

bool UdpSink::is_address(const std::string& host) {
  in_addr address{};
  return inet_pton(AF_INET, host.c_str(), &address) == 1;
}

bool UdpSink::write(const std::string& text) {
  sockaddr_in to{};
  to.sin_family = AF_INET;
  to.sin_port = htons(static_cast<uint16_t>(port_));
  inet_pton(AF_INET, host_.c_str(), &to.sin_addr);
  const auto* address = reinterpret_cast<const sockaddr*>(&to);
  if (::sendto(socket_, text.data(), text.size(), 0, address, sizeof to) == static_cast<ssize_t>(text.size())) {
    return true;
  }
  error_ = fmt::format("{}:{}: {}", host_, port_, std::strerror(errno));
  return false;
}

bool SerialSink::is_baud(int baud) {
  return speed_of(baud).has_value();
}

bool SerialSink::fail(const std::string& what) {
  error_ = fmt::format("{}: {}: {}", device_, what, std::strerror(errno));
  close();
  return false;
}

void SerialSink::close() {
  if (file_ >= 0) ::close(file_);
  file_ = -1;
}

bool SerialSink::open() {
  file_ = ::open(device_.c_str(), O_WRONLY | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
  if (file_ < 0) return fail("cannot be opened");
  termios settings{};
  if (tcgetattr(file_, &settings) != 0) return fail("is no serial device");
  cfmakeraw(&settings);
  settings.c_cflag |= CLOCAL;
  cfsetospeed(&settings, speed_of(baud_).value());
  if (tcsetattr(file_, TCSANOW, &settings) != 0) return fail("refuses its settings");
  return true;
}

bool SerialSink::write(const std::string& text) {
  if (file_ < 0 && !open()) return false;
  const ssize_t written = ::write(file_, text.data(), text.size());
  if (written == static_cast<ssize_t>(text.size())) return true;
  // A line that is too slow for the rate: what does not fit is lost, and the reader's checksum tells.
  if (written >= 0 || errno == EAGAIN) {
    error_ = fmt::format("{}: too slow for this rate", device_);
    return false;
  }
  return fail("cannot be written");
}

}  // namespace orthonav::output
