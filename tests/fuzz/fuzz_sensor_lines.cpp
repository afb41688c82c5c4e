// What a serial or UDP port says: lines in pieces, with times of any kind; the first byte says how long the pieces are.
#include <cstdlib>
#include <string_view>
#include <vector>

#include "services/ingest/sensor_lines.h"
#include "services/ingest/validator.h"

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace orthonav::ingest;
  if (size == 0) return 0;
  const size_t piece = 1 + data[0] % 64;
  // The checksums are put right, so that the fuzzer gets behind them: a line ends with *? .
  std::string text(reinterpret_cast<const char*>(data) + 1, size - 1);
  for (size_t end = text.find("*?"); end != std::string::npos; end = text.find("*?", end + 1)) {
    const size_t start = text.rfind('$', end);
    if (start == std::string::npos) continue;
    constexpr const char* kDigits = "0123456789ABCDEF";
    const uint8_t sum = line_checksum(std::string_view(text).substr(start + 1, end - start - 1));
    text.replace(end + 1, 1, {kDigits[sum >> 4], kDigits[sum & 15]});
  }
  SensorLines lines("fuzz");
  Validator validator;
  std::vector<SensorEvent> events;
  for (size_t at = 0; at < text.size(); at += piece)
    lines.feed(std::string_view(text).substr(at, piece), 1'700'000'000'000'000 + static_cast<int64_t>(at), events);
  for (const SensorEvent& event : events) {
    if (event.message.has_value() == !event.error.empty() || event.error.size() > 200) std::abort();
    if (event.message) validator.check(*event.message);
  }
  return 0;
}
