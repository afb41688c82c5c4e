#include "services/ingest/iio_scan.h"

#include <algorithm>
#include <charconv>
#include <cstdio>
#include <fstream>
#include <stdexcept>

#include <fmt/format.h>

namespace orthonav::ingest {

namespace {

double number_in(const std::filesystem::path& file) {
  const std::string text = read_line(file);
  double value = 0;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (error != std::errc()) throw std::runtime_error(fmt::format("{}: '{}' is no number", file.string(), text));
  return value;
}

// `in_anglvel_x` has the kind `in_anglvel`.
std::string kind_of(const std::string& name) {
  const size_t end = name.rfind('_');
  return end == std::string::npos || end < 3 ? name : name.substr(0, end);
}

double attribute(const std::filesystem::path& device, const std::string& name, const char* what, double otherwise) {
  for (const std::string& owner : {name, kind_of(name)}) {
    const auto file = device / fmt::format("{}_{}", owner, what);
    if (std::filesystem::exists(file)) return number_in(file);
  }
  return otherwise;
}

}  // namespace

std::string read_line(const std::filesystem::path& file) {
  std::ifstream stream(file);
  std::string line;
  if (!std::getline(stream, line)) throw std::runtime_error(file.string() + ": cannot be read");
  return line;
}

IioType IioType::parse(const std::string& text) {
  char endian[3] = {}, sign = 0;
  IioType type;
  int used = 0;
  const int fields = std::sscanf(text.c_str(), "%2[a-z]:%c%2d/%2d>>%2d%n", endian, &sign, &type.bits, &type.storage,
                                 &type.shift, &used);
  const std::string order = endian;
  const bool storage = type.storage == 8 || type.storage == 16 || type.storage == 32 || type.storage == 64;
  if (fields != 5 || static_cast<size_t>(used) != text.size() || (order != "le" && order != "be") ||
      (sign != 's' && sign != 'u') || !storage || type.bits < 1 || type.shift < 0 ||
      type.bits + type.shift > type.storage) {
    throw std::runtime_error(fmt::format("'{}' is no type of a record like le:s16/16>>0", text));
  }
  type.big_endian = order == "be";
  type.is_signed = sign == 's';
  return type;
}

int64_t IioType::decode(const uint8_t* bytes) const {
  const size_t count = static_cast<size_t>(storage) / 8;
  uint64_t value = 0;
  for (size_t i = 0; i < count; ++i) value = value << 8 | bytes[big_endian ? i : count - 1 - i];
  value >>= shift;
  if (bits == 64) return static_cast<int64_t>(value);
  value &= (uint64_t{1} << bits) - 1;
  const bool negative = is_signed && (value >> (bits - 1) & 1) != 0;
  return static_cast<int64_t>(negative ? value | ~((uint64_t{1} << bits) - 1) : value);
}

size_t lay_out(std::vector<IioChannel>& channels) {
  std::sort(channels.begin(), channels.end(), [](const auto& a, const auto& b) { return a.index < b.index; });
  size_t length = 0, largest = 1;
  const auto align = [&](size_t size) { length = (length + size - 1) / size * size; };
  for (IioChannel& channel : channels) {
    const auto size = static_cast<size_t>(channel.type.storage) / 8;
    align(size);
    channel.position = length;
    length += size;
    largest = std::max(largest, size);
  }
  align(largest);
  return length;
}

IioChannel read_channel(const std::filesystem::path& device, const std::string& name) {
  const auto element = device / "scan_elements" / name;
  IioChannel channel;
  channel.name = name;
  try {
    channel.type = IioType::parse(read_line(element.string() + "_type"));
  } catch (const std::runtime_error& error) {
    throw std::runtime_error(fmt::format("{}_type: {}", element.string(), error.what()));
  }
  const double index = number_in(element.string() + "_index");
  if (!(index >= 0 && index < 1000))
    throw std::runtime_error(fmt::format("{}_index: {} is no index", element.string(), index));
  channel.index = static_cast<int>(index);
  channel.scale = attribute(device, name, "scale", 1);
  channel.offset = attribute(device, name, "offset", 0);
  return channel;
}

}  // namespace orthonav::ingest
