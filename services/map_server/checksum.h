// 64-bit FNV-1a over 8-byte words: detects damage and tells inputs apart; no defence against forgery.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <string>

namespace orthonav::map_server {

class Checksum {
 public:
  void add(const void* data, size_t size) {
    constexpr uint64_t kPrime = 1099511628211ULL;
    const auto* bytes = static_cast<const unsigned char*>(data);
    while (size >= 8) {
      uint64_t word = 0;
      std::memcpy(&word, bytes, 8);
      value_ = (value_ ^ word) * kPrime;
      // The multiplication moves information upwards only: bring it down again.
      value_ ^= value_ >> 32;
      bytes += 8;
      size -= 8;
    }
    for (; size > 0; --size, ++bytes) value_ = (value_ ^ *bytes) * kPrime;
  }
  void add(const std::string& text) { add(text.data(), text.size()); }
  uint64_t value() const { return value_; }

 private:
  uint64_t value_ = 14695981039346656037ULL;
};

}  // namespace orthonav::map_server
