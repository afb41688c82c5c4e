#include "services/output/options.h"

#include <cctype>

#include "common/config/config.h"
#include "services/output/sinks.h"

namespace orthonav::output {

OutputOptions OutputOptions::load(const std::filesystem::path& file) {
  OutputOptions options;
  ConfigNode root = ConfigNode::load(file);
  ConfigNode nmea = root.child_or_empty("nmea");
  nmea.read("rate_hz", options.rate_hz, 0.1, 200.0);
  nmea.read("talker", options.nmea.talker);
  const std::string& talker = options.nmea.talker;
  if (talker.size() != 2 || std::isupper(static_cast<unsigned char>(talker[0])) == 0 ||
      std::isupper(static_cast<unsigned char>(talker[1])) == 0) {
    nmea.fail("talker", "two capital letters");
  }
  nmea.read("geoid_separation", options.nmea.geoid_separation, -200.0, 200.0);
  ConfigNode udp = nmea.child_or_empty("udp");
  udp.read("enabled", options.udp.enabled);
  udp.read("host", options.udp.host);
  udp.read("port", options.udp.port, 1, 65535);
  if (!UdpSink::is_address(options.udp.host)) udp.fail("host", "an IPv4 address");
  udp.finish();
  ConfigNode serial = nmea.child_or_empty("serial");
  serial.read("enabled", options.serial.enabled);
  serial.read("device", options.serial.device);
  serial.read("baud", options.serial.baud);
  if (!SerialSink::is_baud(options.serial.baud))
    serial.fail("baud", "4800, 9600, 19200, 38400, 57600, 115200 or 230400");
  serial.finish();
  nmea.finish();
  root.finish();
  return options;
}

}  // namespace orthonav::output
