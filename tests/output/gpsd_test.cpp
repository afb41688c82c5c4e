// A real gpsd listens to the output, and its JSON says where the aircraft is.
#include <chrono>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <optional>
#include <string>
#include <thread>

#include <arpa/inet.h>
#include <gtest/gtest.h>
#include <netinet/in.h>
#include <nlohmann/json.hpp>
#include <sys/socket.h>
#include <unistd.h>

#include "common/bus/channels.h"
#include "services/output/output_service.h"
#include "tests/support/child_process.h"
#include "tests/support/temporary_folder.h"

namespace orthonav::output {
namespace {

constexpr int kNmeaPort = 21110;
constexpr int kGpsdPort = 21947;

// gpsd's JSON, line by line.
class GpsdClient {
 public:
  ~GpsdClient() {
    if (socket_ >= 0) ::close(socket_);
  }
  bool connect(std::chrono::seconds timeout) {
    const auto deadline = std::chrono::steady_clock::now() + timeout;
    while (std::chrono::steady_clock::now() < deadline) {
      socket_ = ::socket(AF_INET, SOCK_STREAM, 0);
      sockaddr_in to{};
      to.sin_family = AF_INET;
      to.sin_port = htons(kGpsdPort);
      to.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
      if (::connect(socket_, reinterpret_cast<const sockaddr*>(&to), sizeof to) == 0) {
        const timeval patience{0, 100'000};
        setsockopt(socket_, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience);
        const std::string watch = "?WATCH={\"enable\":true,\"json\":true};\n";
        return ::send(socket_, watch.data(), watch.size(), 0) > 0;
      }
      ::close(socket_);
      socket_ = -1;
      std::this_thread::sleep_for(std::chrono::milliseconds(100));
    }
    return false;
  }
  // The next object of a class that is here, if any.
  std::optional<nlohmann::json> next(const std::string& wanted) {
    char buffer[4096];
    const ssize_t got = ::recv(socket_, buffer, sizeof buffer, 0);
    if (got > 0) text_.append(buffer, static_cast<size_t>(got));
    for (size_t end; (end = text_.find('\n')) != std::string::npos;) {
      const auto object = nlohmann::json::parse(text_.substr(0, end), nullptr, false);
      text_.erase(0, end + 1);
      if (object.is_object() && object.value("class", "") == wanted) return object;
    }
    return std::nullopt;
  }

 private:
  int socket_ = -1;
  std::string text_;
};

nav_state_t flying(int64_t utime) {
  nav_state_t nav{};
  nav.utime = utime;
  nav.mode = nav_state_t::MAP_AIDED;
  nav.latitude_deg = 44.6234567;
  nav.longitude_deg = -5.1012345;
  nav.ellipsoidal_height = 712.25;
  nav.v_G_B[0] = 3.0;
  nav.v_G_B[1] = 4.0;
  for (int k = 0; k < 3; ++k) nav.covariance[7 * k] = 4.0;
  nav.num_fixes = 9;
  return nav;
}

TEST(Gpsd, ReadsThePositionBack) {
  if (!std::filesystem::exists("/usr/sbin/gpsd")) GTEST_SKIP() << "gpsd is not installed";
  const test::TemporaryFolder folder;
  std::ofstream(folder.path() / "output.yaml")
      << "nmea: {rate_hz: 10, udp: {enabled: true, port: " << kNmeaPort << "}}\n";
  test::ChildProcess gpsd(
      {"/usr/sbin/gpsd", "-N", "-n", "-S", std::to_string(kGpsdPort), "udp://127.0.0.1:" + std::to_string(kNmeaPort)});
  GpsdClient client;
  ASSERT_TRUE(client.connect(std::chrono::seconds(10)));

  lcm::LCM bus("memq://");
  Node node({.service = "output"}, bus);
  OutputService service(node, folder.path());
  const auto now = std::chrono::system_clock::now().time_since_epoch();
  int64_t utime = std::chrono::duration_cast<std::chrono::microseconds>(now).count();
  std::optional<nlohmann::json> fix;
  for (int k = 0; k < 150 && !fix; ++k) {
    utime += 100'000;
    const nav_state_t nav = flying(utime);
    bus.publish(channel::kNavState, &nav);
    while (bus.handleTimeout(0) > 0) {
    }
    auto report = client.next("TPV");
    if (report && report->value("mode", 0) == 3 && report->contains("lat") && report->contains("speed")) fix = report;
  }
  ASSERT_TRUE(fix) << "no fix from gpsd; sent " << node.health().counter("udp.sent") << " reports";
  EXPECT_NEAR(fix->at("lat").get<double>(), 44.6234567, 1e-6);
  EXPECT_NEAR(fix->at("lon").get<double>(), -5.1012345, 1e-6);
  EXPECT_NEAR(fix->at("altHAE").get<double>(), 712.25, 0.01);
  EXPECT_NEAR(fix->at("speed").get<double>(), 5.0, 0.01);
  EXPECT_NEAR(fix->at("track").get<double>(), 36.87, 0.01);
}

}  // namespace
}  // namespace orthonav::output
