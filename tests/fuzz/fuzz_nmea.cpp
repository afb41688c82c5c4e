// NMEA sentences of any numbers: whatever the position, a sentence is printable ASCII between $ and CR LF.
#include <cstdlib>
#include <cstring>

#include "services/output/nmea.h"

namespace {

void check(const std::string& sentence) {
  if (sentence.size() < 9 || sentence[0] != '$' || sentence.substr(sentence.size() - 2) != "\r\n") std::abort();
  for (size_t i = 1; i + 2 < sentence.size(); ++i) {
    if (sentence[i] < ' ' || sentence[i] > '~' || sentence[i] == '$') std::abort();
  }
  // What a reader of NMEA 0183 has room for.
  if (sentence.size() > 200) std::abort();
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace orthonav::output;
  double numbers[19] = {};
  std::memcpy(numbers, data, std::min(size, sizeof(numbers)));
  Report report;
  std::memcpy(&report.utime, &numbers[0], sizeof(report.utime));
  uint64_t kind = 0;
  std::memcpy(&kind, &numbers[1], sizeof(kind));
  report.quality = static_cast<Quality>(kind % 3);
  report.num_fixes = static_cast<int>(kind >> 8);
  report.latitude_deg = numbers[2];
  report.longitude_deg = numbers[3];
  report.ellipsoidal_height = numbers[4];
  report.velocity_enu = {numbers[5], numbers[6], numbers[7]};
  report.covariance = Eigen::Map<const Eigen::Matrix3d>(&numbers[8]);
  NmeaOptions options;
  options.geoid_separation = numbers[17];
  check(gga(report, options));
  check(rmc(report, options));
  check(gst(report, options));
  return 0;
}
