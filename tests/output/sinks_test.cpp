// A serial line and a UDP port at whose other end somebody reads; and configurations that are none.
#include "services/output/sinks.h"

#include <filesystem>
#include <fstream>

#include <fcntl.h>
#include <gtest/gtest.h>
#include <stdlib.h>
#include <unistd.h>

#include "common/config/config.h"
#include "services/output/options.h"

namespace orthonav::output {
namespace {

TEST(SerialSink, WritesToATerminalAndOpensItAgain) {
  const int master = posix_openpt(O_RDWR | O_NOCTTY);
  ASSERT_GE(master, 0);
  ASSERT_EQ(grantpt(master), 0);
  ASSERT_EQ(unlockpt(master), 0);
  SerialSink sink(ptsname(master), 38400);
  ASSERT_TRUE(sink.write("$GPGGA\r\n")) << sink.error();
  char buffer[64] = {};
  ASSERT_EQ(::read(master, buffer, sizeof buffer), 8);
  EXPECT_STREQ(buffer, "$GPGGA\r\n") << "not a byte changed on the way";
  ::close(master);
}

TEST(SerialSink, SaysWhatIsWrongWithADevice) {
  SerialSink missing("/dev/no_such_line", 38400);
  EXPECT_FALSE(missing.write("x"));
  EXPECT_NE(missing.error().find("/dev/no_such_line"), std::string::npos);
  SerialSink no_line("/dev/null", 38400);
  EXPECT_FALSE(no_line.write("x"));
}

std::filesystem::path written(const std::string& text) {
  const auto file = std::filesystem::path(::testing::TempDir()) / "output.yaml";
  std::ofstream(file) << text;
  return file;
}

TEST(OutputOptions, EverythingIsOffUnlessSwitchedOn) {
  const auto options = OutputOptions::load(std::filesystem::path(ORTHONAV_SOURCE) / "config/default/output.yaml");
  EXPECT_FALSE(options.udp.enabled);
  EXPECT_FALSE(options.serial.enabled);
}

TEST(OutputOptions, NonsenseIsRefused) {
  EXPECT_THROW(OutputOptions::load(written("nmea: {talker: gps}")), ConfigError);
  EXPECT_THROW(OutputOptions::load(written("nmea: {udp: {host: example.org}}")), ConfigError);
  EXPECT_THROW(OutputOptions::load(written("nmea: {serial: {baud: 1234}}")), ConfigError);
  EXPECT_THROW(OutputOptions::load(written("nmea: {rate: 3}")), ConfigError);
}

}  // namespace
}  // namespace orthonav::output
