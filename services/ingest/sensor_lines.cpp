#include "services/ingest/sensor_lines.h"

#include <charconv>
#include <cmath>
#include <limits>
#include <optional>

#include <fmt/format.h>

namespace orthonav::ingest {

namespace {

constexpr size_t kLongestLine = 200;
constexpr int64_t kSilentNoise = 2;  // bytes: the end of a line

struct Fields {
  int64_t time = 0;
  std::vector<double> numbers;
};

// The time and the numbers after a line's name; nullopt when one of them is none.
std::optional<Fields> fields_of(std::string_view text) {
  Fields fields;
  bool first = true;
  while (!text.empty()) {
    text.remove_prefix(1);  // the comma
    const size_t end = std::min(text.find(','), text.size());
    const char* last = text.data() + end;
    double number = 0;
    const auto result =
        first ? std::from_chars(text.data(), last, fields.time) : std::from_chars(text.data(), last, number);
    if (result.ec != std::errc() || result.ptr != last) return std::nullopt;
    if (!first) fields.numbers.push_back(number);
    first = false;
    text.remove_prefix(end);
  }
  if (first) return std::nullopt;
  return fields;
}

bool hexadecimal(std::string_view text, uint8_t& value) {
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value, 16);
  return text.size() == 2 && error == std::errc() && end == text.data() + text.size();
}

// Printable, and short enough for a health message.
std::string shown(std::string_view text) {
  std::string result(text.substr(0, 60));
  for (char& c : result) {
    if (c < ' ' || c > '~') c = '?';
  }
  return result;
}

// The message that a line's name and numbers make, not yet stamped; nullopt when the numbers are too few or too many.
std::optional<SensorMessage> message_of(std::string_view name, const std::vector<double>& n) {
  if (name == "IMU" && (n.size() == 6 || n.size() == 7)) {
    imu_t m{};
    for (size_t i = 0; i < 3; ++i) {
      m.angular_rate[i] = n[i];
      m.specific_force[i] = n[3 + i];
    }
    m.temperature_deg_c = n.size() == 7 ? static_cast<float>(n[6]) : std::numeric_limits<float>::quiet_NaN();
    return m;
  }
  if (name == "MAG" && n.size() == 3) {
    magnetometer_t m{};
    for (size_t i = 0; i < 3; ++i) m.field[i] = n[i] * 1e-6;
    return m;
  }
  if (name == "HDG" && n.size() == 2) {
    compass_t m{};
    m.heading = n[0] * M_PI / 180;
    m.heading_stddev = n[1] * M_PI / 180;
    return m;
  }
  if (name == "ALT" && n.size() == 2) {
    altitude_t m{};
    m.height_above_ground = n[0];
    m.stddev = n[1];
    return m;
  }
  return std::nullopt;
}

}  // namespace

uint8_t line_checksum(std::string_view text) {
  uint8_t sum = 0;
  for (const char c : text) sum = static_cast<uint8_t>(sum ^ static_cast<uint8_t>(c));
  return sum;
}

void SensorLines::restart() {
  line_.clear();
  noise_ = 0;
  clock_ = SensorClock();
}

void SensorLines::feed(std::string_view bytes, int64_t arrival, std::vector<SensorEvent>& events) {
  const auto report_noise = [&] {
    if (noise_ > kSilentNoise)
      events.push_back({std::nullopt, fmt::format("{}: {} bytes that are no line", source_, noise_)});
    noise_ = 0;
  };
  for (const char c : bytes) {
    if (c == '$') {
      noise_ += static_cast<int64_t>(line_.size());
      report_noise();
      line_ = c;
    } else if (line_.empty()) {
      ++noise_;
    } else if (c == '\n' || c == '\r') {
      events.push_back(parse(line_, arrival));
      line_.clear();
    } else if (line_.size() >= kLongestLine) {
      noise_ += static_cast<int64_t>(line_.size()) + 1;
      line_.clear();
    } else {
      line_ += c;
    }
  }
  // Without a $ noise would never be told of.
  if (noise_ >= int64_t{kLongestLine}) report_noise();
}

SensorEvent SensorLines::parse(std::string_view line, int64_t arrival) {
  const auto refuse = [&](const char* why) {
    return SensorEvent{std::nullopt, fmt::format("{}: {}: '{}'", source_, why, shown(line))};
  };
  const size_t star = line.rfind('*');
  uint8_t sum = 0;
  if (star == std::string_view::npos || !hexadecimal(line.substr(star + 1), sum))
    return refuse("a line without checksum");
  const std::string_view text = line.substr(1, star - 1);
  if (sum != line_checksum(text)) return refuse("the checksum is wrong");
  const size_t comma = std::min(text.find(','), text.size());
  const auto fields = fields_of(text.substr(comma));
  if (!fields) return refuse("a field that is no number");
  auto message = message_of(text.substr(0, comma), fields->numbers);
  if (!message) return refuse("an unknown line, or the wrong number of fields");
  const int64_t utime = utc_ ? fields->time : clock_.to_host(fields->time, arrival);
  std::visit([&](auto& m) { m.utime = utime; }, *message);
  return {std::move(message), ""};
}

}  // namespace orthonav::ingest
