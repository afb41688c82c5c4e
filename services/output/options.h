// Every parameter of the output. config/default/output.yaml says what each is for.
#pragma once

#include <filesystem>
#include <string>

#include "services/output/nmea.h"

namespace orthonav::output {

struct OutputOptions {
  struct Udp {
    bool enabled = false;
    std::string host = "127.0.0.1";  // IPv4 address
    int port = 10110;
  } udp;
  struct Serial {
    bool enabled = false;
    std::string device = "/dev/ttyUSB0";
    int baud = 38400;
  } serial;
  double rate_hz = 5.0;
  NmeaOptions nmea;

  // Reads output.yaml. Throws ConfigError with file and line.
  static OutputOptions load(const std::filesystem::path& file);
};

}  // namespace orthonav::output
