// orthonav-ingest --sensors as a process, with the sensors played by the test: a video file, an IIO device's files,
// lines over UDP and a serial port, a network camera.
#include <array>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <map>
#include <optional>

#include <arpa/inet.h>
#include <fcntl.h>
#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <netinet/in.h>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/videoio.hpp>
#include <pty.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include "common/bus/channels.h"
#include "common/bus/node.h"
#include "orthonav/compass_t.hpp"
#include "orthonav/health_t.hpp"
#include "orthonav/image_t.hpp"
#include "orthonav/imu_t.hpp"
#include "orthonav/magnetometer_t.hpp"
#include "services/ingest/sensor_lines.h"
#include "tests/support/bus_client.h"
#include "tests/support/child_process.h"
#include "tests/support/temporary_folder.h"

namespace orthonav {
namespace {

using test::ChildProcess;
using test::Collector;
using testing::HasSubstr;
namespace fs = std::filesystem;

int64_t time_of(clockid_t clock) {  // microseconds
  timespec time{};
  clock_gettime(clock, &time);
  return int64_t{time.tv_sec} * 1'000'000 + time.tv_nsec / 1000;
}

class SensorsOfABoard : public testing::Test {
 protected:
  void start(const std::string& yaml) {
    std::ofstream(folder_ / "ingest.yaml") << yaml;
    ingest_.emplace(
        std::vector<std::string>{test::program("orthonav-ingest"), "--config", folder_.path(), "--sensors"});
  }
  // Handles the bus and lets `play` act a hundred times a second, until `done`.
  bool play_until(const std::function<void()>& play, const std::function<bool()>& done) {
    const auto end = std::chrono::steady_clock::now() + test::kPatience;
    auto next = std::chrono::steady_clock::now();
    while (!done()) {
      const auto now = std::chrono::steady_clock::now();
      if (now >= end) return false;
      if (now >= next) {
        play();
        next += std::chrono::milliseconds(10);
      }
      bus_.handleTimeout(2);
    }
    return true;
  }
  bool health_is(Health::State state, const std::string& text = "") const {
    if (health_.messages.empty()) return false;
    const health_t& last = health_.messages.back();
    return last.state == static_cast<int8_t>(state) && last.message.find(text) != std::string::npos;
  }
  // OK, or DEGRADED for nothing but the machine's receive buffer.
  bool sound() const { return health_is(Health::State::kOk) || health_is(Health::State::kDegraded, "receive buffer"); }
  std::string last_message() const { return health_.messages.empty() ? "" : health_.messages.back().message; }
  // How long until the health says so, s, while `play` goes on.
  double time_until_said(
      const std::string& text, const std::function<void()>& play = [] {}) {
    const auto start = std::chrono::steady_clock::now();
    EXPECT_TRUE(play_until(play, [&] { return health_is(Health::State::kDegraded, text); }))
        << text << "; it says: " << last_message();
    return std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  }

  test::TemporaryFolder folder_;
  lcm::LCM bus_;
  Collector<imu_t> imu_{bus_, channel::kImu};
  Collector<image_t> camera_{bus_, channel::kCamera};
  Collector<magnetometer_t> magnetometer_{bus_, channel::kMagnetometer};
  Collector<compass_t> compass_{bus_, channel::kCompass};
  Collector<health_t> health_{bus_, channel::kHealth};
  std::optional<ChildProcess> ingest_;
};

// ---- camera ---------------------------------------------------------------------------------------------------------

cv::Mat picture(int number) {
  return cv::Mat(48, 64, CV_8UC3, cv::Scalar::all(5 * number));
}

TEST_F(SensorsOfABoard, AVideoFileIsPlayedAtItsOwnTimesAndEndsTheService) {
  {
    cv::VideoWriter video(folder_ / "flight.avi", cv::CAP_OPENCV_MJPEG, cv::VideoWriter::fourcc('M', 'J', 'P', 'G'), 20,
                          {64, 48});
    for (int i = 0; i < 30; ++i) video.write(picture(i));
  }
  const int64_t before = time_of(CLOCK_REALTIME);
  start(fmt::format("camera:\n  source: {}\n  jpeg_quality: 0\n", (folder_ / "flight.avi").string()));
  ASSERT_TRUE(test::handle_until(bus_, [&] { return camera_.messages.size() == 30; }));
  EXPECT_EQ(ingest_->wait_exit(test::kPatience), 0);
  EXPECT_GT(camera_.messages[0].utime, before);
  for (size_t i = 0; i < 30; ++i) {
    const image_t& image = camera_.messages[i];
    EXPECT_EQ(image.utime - camera_.messages[0].utime, 50'000 * static_cast<int64_t>(i));
    EXPECT_EQ(image.pixelformat, image_t::PIXEL_FORMAT_GRAY);
    EXPECT_EQ(image.width, 64);
    ASSERT_EQ(image.size, 64 * 48);
    EXPECT_NEAR(image.data[1000], 5.0 * static_cast<double>(i), 3);
  }
  EXPECT_GT(time_of(CLOCK_REALTIME) - before, 29 * 50'000) << "as fast as it was filmed";
}

// A camera that serves MJPEG over HTTP, as they do: one client, pictures on demand.
class NetworkCamera {
 public:
  NetworkCamera() : server_(socket(AF_INET, SOCK_STREAM | SOCK_NONBLOCK, 0)) {
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    socklen_t size = sizeof(address);
    if (bind(server_, reinterpret_cast<sockaddr*>(&address), size) != 0 || listen(server_, 4) != 0 ||
        getsockname(server_, reinterpret_cast<sockaddr*>(&address), &size) != 0)
      throw std::runtime_error("no port for the camera");
    port_ = ntohs(address.sin_port);
  }
  ~NetworkCamera() {
    unplug();
    close(server_);
  }
  NetworkCamera(const NetworkCamera&) = delete;
  NetworkCamera& operator=(const NetworkCamera&) = delete;

  std::string url() const { return fmt::format("http://127.0.0.1:{}/stream.mjpg", port_); }
  void show() {
    if (client_ < 0) {
      client_ = accept(server_, nullptr, nullptr);
      say("HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=frame\r\n\r\n");
    }
    std::vector<uint8_t> jpeg;
    cv::imencode(".jpg", picture(++number_ % 50), jpeg);
    say(fmt::format("--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {}\r\n\r\n", jpeg.size()) +
        std::string(jpeg.begin(), jpeg.end()) + "\r\n");
  }
  void unplug() {
    if (client_ >= 0) close(client_);
    client_ = -1;
  }

 private:
  void say(const std::string& text) {
    if (client_ >= 0 && send(client_, text.data(), text.size(), MSG_NOSIGNAL) < 0) unplug();
  }
  int server_, client_ = -1, port_ = 0, number_ = 0;
};

TEST_F(SensorsOfABoard, ANetworkCameraThatGoesIsReportedWithinASecondAndPickedUpAgain) {
  NetworkCamera camera;
  start(fmt::format("camera:\n  source: {}\n", camera.url()));
  const auto show = [&] { camera.show(); };
  ASSERT_TRUE(play_until(show, [&] { return camera_.messages.size() > 20 && sound(); })) << last_message();
  EXPECT_EQ(camera_.messages.back().pixelformat, image_t::PIXEL_FORMAT_MJPEG);
  EXPECT_NEAR(static_cast<double>(time_of(CLOCK_REALTIME) - camera_.messages.back().utime), 0, 1e6);
  camera.unplug();
  EXPECT_LT(time_until_said("CAMERA: silent"), 1.0);
  const size_t before = camera_.messages.size();
  ASSERT_TRUE(play_until(show, [&] { return camera_.messages.size() > before + 20 && sound(); })) << last_message();
}

TEST_F(SensorsOfABoard, APipelineOfGStreamerThatEndsIsBegunAgain) {
  start(
      "camera:\n  source: \"videotestsrc num-buffers=15 is-live=true pattern=ball ! "
      "video/x-raw,format=GRAY8,width=64,height=48,framerate=30/1 ! appsink\"\n");
  ASSERT_TRUE(test::handle_until(bus_, [&] { return camera_.messages.size() > 20; })) << last_message();
  for (size_t i = 1; i < camera_.messages.size(); ++i)
    EXPECT_LT(camera_.messages[i - 1].utime, camera_.messages[i].utime);
}

// ---- IIO ------------------------------------------------------------------------------------------------------------

// The files of an IIO device as the kernel shows them; a FIFO takes the place of its character device.
class IioFiles {
 public:
  IioFiles(const fs::path& root, const std::string& device, const std::string& name) : fifo_(root / "dev" / device) {
    folder_ = root / "sys" / device;
    fs::create_directories(folder_ / "scan_elements");
    fs::create_directories(folder_ / "buffer");
    fs::create_directories(root / "dev");
    write("name", name);
    write("buffer/enable", "0");
    write("buffer/length", "2");
    write("sampling_frequency", "50");
    write("current_timestamp_clock", "realtime");
    plug();
  }
  ~IioFiles() { unplug(); }
  IioFiles(const IioFiles&) = delete;
  IioFiles& operator=(const IioFiles&) = delete;

  void write(const std::string& file, const std::string& text) const { std::ofstream(folder_ / file) << text << "\n"; }
  std::string text(const std::string& file) const {
    std::string line;
    std::ifstream(folder_ / file) >> line;
    return line;
  }
  void channel(const std::string& name, int index, const std::string& type) const {
    write("scan_elements/" + name + "_en", "0");
    write("scan_elements/" + name + "_index", std::to_string(index));
    write("scan_elements/" + name + "_type", type);
  }
  // Into the buffer, if somebody has it open.
  void record(const void* bytes, size_t size) {
    if (fd_ < 0) fd_ = open(fifo_.c_str(), O_WRONLY | O_NONBLOCK);
    if (fd_ >= 0 && ::write(fd_, bytes, size) < 0) hang_up();
  }
  void plug() const { mkfifo(fifo_.c_str(), 0600); }
  void unplug() {
    hang_up();
    fs::remove(fifo_);
  }

 private:
  void hang_up() {
    if (fd_ >= 0) close(fd_);
    fd_ = -1;
  }
  fs::path folder_, fifo_;
  int fd_ = -1;
};

struct ImuRecord {
  int16_t rate[3];   // big endian, 0.001 rad/s
  int16_t force[3];  // big endian, 0.01 m/s^2
  uint8_t padding[4];
  int64_t time_ns;
};

int16_t big_endian(int value) {
  return static_cast<int16_t>(htons(static_cast<uint16_t>(value)));
}

class IioImu : public SensorsOfABoard {
 protected:
  void SetUp() override {
    signal(SIGPIPE, SIG_IGN);
    files_.emplace(folder_.path(), "iio:device3", "icm20608");
    int index = 0;
    for (const char* kind : {"in_anglvel", "in_accel"}) {
      for (const char* axis : {"_x", "_y", "_z"}) files_->channel(std::string(kind) + axis, index++, "be:s16/16>>0");
    }
    files_->channel("in_temp", index++, "be:s16/16>>0");
    files_->channel("in_timestamp", index, "le:s64/64>>0");
    files_->write("in_anglvel_scale", "0.001");
    files_->write("in_accel_scale", "0.01");
    files_->write("in_accel_z_offset", "1");
  }
  std::string yaml() const {
    return fmt::format(
        "iio_imu:\n  device: icm20608\n  sysfs: {0}/sys\n  dev: {0}/dev\n  rate_hz: 200\n"
        "  R_B_S: [0, 1, 0, -1, 0, 0, 0, 0, 1]\n",
        folder_.path().string());
  }
  void measure() {
    ImuRecord record{};
    ++measured_;
    record.rate[0] = big_endian(100 + measured_ % kMeasured);
    record.rate[1] = big_endian(-200 - measured_ % 3);
    record.rate[2] = big_endian(measured_ % 5);
    for (int16_t& force : record.force) force = big_endian(measured_ % 4);
    record.force[2] = big_endian(980 + measured_ % 7);
    // Written some 40 ms after it was measured, at times that no arrival explains.
    const int64_t late = 40'000 - 977 * (measured_ % 7);
    record.time_ns = 1000 * (time_of(clock_) - late);
    stamps_[measured_ % kMeasured] = time_of(CLOCK_REALTIME) - late;
    files_->record(&record, sizeof(record));
  }
  // Which sample it is: measured_ in measure().
  static int number_of(const imu_t& m) { return static_cast<int>(std::lround(-1000 * m.angular_rate[1])) - 100; }
  // When a sample was measured, by the wall clock.
  int64_t stamp_of(const imu_t& m) const { return stamps_.at(number_of(m)); }
  bool flows(size_t more) {
    const size_t before = imu_.messages.size();
    return play_until([this] { measure(); }, [&] { return imu_.messages.size() > before + more && sound(); });
  }

  static constexpr int kMeasured = 5000;
  std::optional<IioFiles> files_;
  int measured_ = 0;
  clockid_t clock_ = CLOCK_REALTIME;
  std::map<int, int64_t> stamps_;  // by measured_
};

TEST_F(IioImu, IsSetUpAndItsRecordsBecomeSamplesWithTheKernelsStamps) {
  start(yaml());
  ASSERT_TRUE(flows(100)) << last_message();
  EXPECT_EQ(files_->text("scan_elements/in_accel_z_en"), "1");
  EXPECT_EQ(files_->text("scan_elements/in_timestamp_en"), "1");
  EXPECT_EQ(files_->text("scan_elements/in_temp_en"), "0");
  EXPECT_EQ(files_->text("buffer/enable"), "1");
  EXPECT_EQ(files_->text("sampling_frequency"), "200");
  const imu_t& sample = imu_.messages.back();
  const int number = number_of(sample);
  EXPECT_NEAR(sample.angular_rate[0], -0.2 - 0.001 * (number % 3), 1e-9) << "turned into the body's axes";
  EXPECT_LE(sample.angular_rate[1], -0.1);
  EXPECT_NEAR(sample.specific_force[2], 9.81 + 0.01 * (number % 7), 1e-9) << "with the axis's offset";
  for (const imu_t& m : imu_.messages) EXPECT_NEAR(static_cast<double>(m.utime - stamp_of(m)), 0, 500);
}

TEST_F(IioImu, ThatStampsByTheMonotonicClockIsUnderstood) {
  clock_ = CLOCK_MONOTONIC;
  files_->write("current_timestamp_clock", "monotonic");
  start(yaml());
  ASSERT_TRUE(flows(100)) << last_message();
  for (const imu_t& m : imu_.messages) EXPECT_NEAR(static_cast<double>(m.utime - stamp_of(m)), 0, 500);
}

TEST_F(IioImu, ThatStampsByAClockThatSaysNothingIsRefused) {
  files_->write("current_timestamp_clock", "boottime");
  start(yaml());
  time_until_said("stamps by 'boottime'");
}

TEST_F(IioImu, WhoseClockIsOfAnotherTimeIsReportedWithinASecondAndKeptOffTheBus) {
  start(yaml());
  ASSERT_TRUE(flows(20)) << last_message();
  clock_ = CLOCK_MONOTONIC;  // since the machine was started, in place of since 1970
  EXPECT_LT(time_until_said("behind this board's clock", [this] { measure(); }), 1.0);
  clock_ = CLOCK_REALTIME;
  ASSERT_TRUE(flows(20)) << last_message();
  for (const imu_t& m : imu_.messages) EXPECT_NEAR(static_cast<double>(m.utime - stamp_of(m)), 0, 500);
}

TEST_F(IioImu, ThatStopsOrIsPulledOutIsReportedWithinASecondAndPickedUpAgain) {
  start(yaml());
  ASSERT_TRUE(flows(20)) << last_message();
  EXPECT_LT(time_until_said("IMU: silent"), 1.0);
  ASSERT_TRUE(flows(20)) << last_message();
  files_->unplug();
  EXPECT_LT(time_until_said("No such file"), 1.0);
  files_->plug();
  ASSERT_TRUE(flows(20)) << last_message();
}

TEST_F(IioImu, ThatFreezesIsReportedWithinASecondAndKeptOffTheBus) {
  start(yaml());
  ASSERT_TRUE(flows(20)) << last_message();
  const auto freeze = [this] {
    measured_ = 7;
    measure();
  };
  EXPECT_LT(time_until_said("very same reading", freeze), 1.0);
  ASSERT_TRUE(flows(20)) << last_message();
}

TEST_F(IioImu, ThatIsNotThereIsNamedWithThoseThatAre) {
  start(fmt::format("iio_imu:\n  device: bmi160\n  sysfs: {0}/sys\n  dev: {0}/dev\n", folder_.path().string()));
  time_until_said("there is no device 'bmi160'; there are: icm20608");
}

// ---- lines ----------------------------------------------------------------------------------------------------------

std::string line(const std::string& text) {
  return fmt::format("${}*{:02X}\r\n", text, ingest::line_checksum(text));
}

// No axis of a real sensor reads the same for long.
std::string imu_line(int64_t time, int number) {
  const double noise = 0.01 * (number % 7);
  return line(
      fmt::format("IMU,{},{},{},{},{},{},{}", time, 0.01 + noise, 0.02 + noise, noise, noise, noise, 9.81 + noise));
}

TEST_F(SensorsOfABoard, LinesOverUdpWithGarbageBetweenThemBecomeSamplesWithTheSensorsSpacing) {
  // A port that was free a moment ago, and nobody else is in this network namespace.
  const int fd = socket(AF_INET, SOCK_DGRAM, 0);
  sockaddr_in address{};
  address.sin_family = AF_INET;
  address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  address.sin_port = htons(14600);
  ASSERT_EQ(connect(fd, reinterpret_cast<sockaddr*>(&address), sizeof(address)), 0);
  start("lines:\n  port: udp://127.0.0.1:14600\n  channels: [IMU, MAGNETOMETER, COMPASS]\n");
  int number = 0;
  const auto speak = [&] {
    ++number;
    // The sensor's clock began with its own start, and goes on at 10 ms however late a datagram is.
    const int64_t time = 10'000 * number;
    std::string text = "\xFF\xFE$IMU,1,2*00\r\n";
    text += imu_line(time, number);
    if (number % 5 == 0) text += line(fmt::format("MAG,{},20,0,{}", time, -44 + number % 3));
    if (number % 5 == 0) text += line(fmt::format("HDG,{},45,2", time));
    text += "$MAG,not a line at all";
    send(fd, text.data(), text.size(), 0);
  };
  ASSERT_TRUE(play_until(speak, [&] {
    return imu_.messages.size() > 100 && !magnetometer_.messages.empty() && !compass_.messages.empty();
  })) << last_message();
  for (size_t i = imu_.messages.size() - 50; i < imu_.messages.size(); ++i) {
    const double spacing = static_cast<double>(imu_.messages[i].utime - imu_.messages[i - 1].utime);
    EXPECT_NEAR(std::remainder(spacing, 10'000), 0, 1000) << "whatever was lost, the spacing is the sensor's";
  }
  EXPECT_NEAR(magnetometer_.messages[0].field[0], 20e-6, 1e-12);
  EXPECT_NEAR(compass_.messages[0].heading, M_PI / 4, 1e-12);
  EXPECT_TRUE(play_until(speak, [&] { return health_is(Health::State::kDegraded, "udp://127.0.0.1:14600: "); }))
      << "garbage is said: " << last_message();
  EXPECT_LT(time_until_said("silent"), 1.0);
  const size_t before = imu_.messages.size();
  EXPECT_TRUE(play_until(speak, [&] { return imu_.messages.size() > before + 20; }));
  close(fd);
}

// A serial port: the far end of a pseudo-terminal, under a name that stays, as udev gives one.
class SerialPort {
 public:
  explicit SerialPort(fs::path name) : name_(std::move(name)) { plug(); }
  ~SerialPort() { unplug(); }
  SerialPort(const SerialPort&) = delete;
  SerialPort& operator=(const SerialPort&) = delete;

  void plug() {
    char path[256] = {};
    if (openpty(&master_, &slave_, path, nullptr, nullptr) != 0) throw std::runtime_error("no pseudo-terminal");
    fcntl(master_, F_SETFL, O_NONBLOCK);
    // A process that inherited an end would keep it plugged in.
    for (const int end : {master_, slave_}) fcntl(end, F_SETFD, FD_CLOEXEC);
    fs::create_symlink(path, name_);
  }
  void unplug() {
    if (master_ < 0) return;
    close(master_);
    close(slave_);
    master_ = -1;
    fs::remove(name_);
  }
  void say(const std::string& text) const {
    // Whoever does not read yet misses it.
    if (write(master_, text.data(), text.size()) < 0) tcflush(master_, TCIOFLUSH);
  }

 private:
  fs::path name_;
  int master_ = -1, slave_ = -1;
};

// An IMU, and what else a test lets it say, a hundred lines a second.
class SensorsOnASerialPort : public SensorsOfABoard {
 protected:
  void start_lines(const std::string& more = "") {
    start(fmt::format("lines:\n  port: {}\n{}", (folder_ / "ttyIMU").string(), more));
  }
  int64_t time() const { return 10'000 * number_; }
  void say(const std::string& text) const { port_.say(line(text)); }
  // Says `readings` at the next time, with noise in them: {n} around nothing, {g} around gravity, {g_in_g}, and {leap}.
  std::function<void()> says(const std::string& readings) {
    return [this, readings] {
      ++number_;
      const double noise = 0.01 * (number_ % 7);
      say(fmt::format(
          "IMU,{},{}", time(),
          fmt::format(fmt::runtime(readings), fmt::arg("n", noise), fmt::arg("g", 9.81 + noise),
                      fmt::arg("g_in_g", 1 + noise), fmt::arg("leap", number_ % 4 == 0 ? 8 : 0.1 + noise))));
    };
  }
  bool recovers() {
    const size_t before = imu_.messages.size();
    return play_until(speak_, [&] { return imu_.messages.size() > before + 20 && sound(); });
  }

  SerialPort port_{folder_ / "ttyIMU"};
  int number_ = 0;
  const std::function<void()> speak_ = [this] {
    ++number_;
    port_.say(imu_line(time(), number_));
  };
};

TEST_F(SensorsOnASerialPort, ASerialPortThatIsPulledOutIsReportedWithinASecondAndReadAgainWhenItIsBack) {
  start_lines("  baud: 921600\n");
  ASSERT_TRUE(recovers()) << last_message();
  port_.unplug();
  EXPECT_LT(time_until_said("IMU: silent"), 1.0);
  EXPECT_THAT(last_message(), HasSubstr("ttyIMU"));
  port_.plug();
  number_ = 0;
  ASSERT_TRUE(recovers()) << last_message();
}

TEST_F(SensorsOnASerialPort, AnInertialSensorThatGoesMadIsReportedWithinASecond) {
  start_lines();
  ASSERT_TRUE(recovers()) << last_message();
  EXPECT_LT(time_until_said("refused: IMU", says("nan,{n},{n},{n},{n},{g}")), 1.0);
  ASSERT_TRUE(recovers()) << last_message();
  EXPECT_LT(time_until_said("refused: IMU", says("1e9,{n},{n},{n},{n},{g}")), 1.0);
  ASSERT_TRUE(recovers()) << last_message();
  for (const imu_t& m : imu_.messages) ASSERT_LT(std::abs(m.angular_rate[0]), 1) << "madness stays off the bus";
  EXPECT_LT(time_until_said("angular_rate[1] has read 0.5", says("{n},0.5,{n},{n},{n},{g}")), 1.0);
  ASSERT_TRUE(recovers()) << last_message();
  EXPECT_LT(time_until_said("angular_rate leaps", says("{leap},{n},{n},{n},{n},{g}")), 1.0);
  ASSERT_TRUE(recovers()) << last_message();
  EXPECT_LT(time_until_said("is it in g?", says("{n},{n},{n},{n},{n},{g_in_g}")), 1.0);
  ASSERT_TRUE(recovers()) << last_message();
}

TEST_F(SensorsOnASerialPort, WhatGoesWrongWhileSomethingElseIsIsReportedWithinASecondToo) {
  start_lines("  channels: [COMPASS, IMU]\n");
  const auto point = [&] {
    speak_();
    if (number_ % 5 == 0) say(fmt::format("HDG,{},{},2", time(), 10 + number_ % 3));
  };
  ASSERT_TRUE(play_until(point, [&] { return compass_.messages.size() > 20 && sound(); })) << last_message();
  EXPECT_LT(time_until_said("COMPASS: silent", speak_), 1.0);
  const size_t before = imu_.messages.size();
  ASSERT_TRUE(play_until(speak_, [&] { return imu_.messages.size() > before + 150; }));
  EXPECT_LT(time_until_said("IMU: angular_rate[1] has read 0.5", says("{n},0.5,{n},{n},{n},{g}")), 1.0);
  EXPECT_THAT(last_message(), HasSubstr("COMPASS: silent"));
}

TEST_F(SensorsOnASerialPort, AnInertialSensorThatSlowsDownIsReportedWithinASecond) {
  start_lines();
  const auto mumble = [&] {
    if (++number_ % 20 == 0) port_.say(imu_line(time(), number_ / 20));
  };
  ASSERT_TRUE(play_until(speak_, [&] { return imu_.messages.size() > 600 && sound(); })) << last_message();
  EXPECT_LT(time_until_said("messages a second, where there were", mumble), 1.0);
  EXPECT_TRUE(play_until(speak_, [&] { return sound(); })) << last_message();
}

TEST_F(SensorsOnASerialPort, ACompassThatStandsStillWhileTheBoardTurnsIsReportedAndKeptOffTheBus) {
  start_lines("  channels: [IMU, COMPASS]\n");
  double yaw = 0, heading = 0;
  // `rate`, rad/s
  const auto turn = [&](double rate, bool frozen) {
    yaw += 0.01 * rate;
    if (!frozen) heading = 180 - yaw * 180 / M_PI;
    says(fmt::format("{{n}},{{n}},{},{{n}},{{n}},{{g}}", rate + 0.001 * (number_ % 7)))();
    if (number_ % 5 == 0) say(fmt::format("HDG,{},{:.1f},2", time(), heading));
  };
  ASSERT_TRUE(play_until([&] { turn(0.5, false); }, [&] { return compass_.messages.size() > 40 && sound(); }))
      << last_message();
  const size_t before = compass_.messages.size();
  ASSERT_TRUE(play_until([&] { turn(0, true); }, [&] { return compass_.messages.size() > before + 40; }))
      << "at rest it may: " << last_message();
  EXPECT_TRUE(sound()) << last_message();
  // 20 degrees are turned after 0.7 s.
  EXPECT_LT(time_until_said("COMPASS: ", [&] { turn(0.5, true); }), 1.7);
  EXPECT_THAT(last_message(), HasSubstr("very same reading"));
  const size_t frozen = compass_.messages.size(), turning = imu_.messages.size();
  ASSERT_TRUE(play_until([&] { turn(0.5, true); }, [&] { return imu_.messages.size() > turning + 50; }));
  EXPECT_LE(compass_.messages.size(), frozen + 1);
  ASSERT_TRUE(play_until([&] { turn(0.5, false); }, [&] { return compass_.messages.size() > frozen + 20 && sound(); }))
      << last_message();
}

}  // namespace
}  // namespace orthonav
