// The optional authenticated mode of the bus: a keyed MAC, a sequence number and a time behind every message.
//
// A sealed message is the LCM message followed by a trailer of 44 bytes, which LCM's decoders pass over: lcm-spy,
// lcm-logger, a replay and programs without the key read sealed messages as ever. The trailer holds, little-endian,
//   sender    8 bytes, drawn at random by each process
//   sequence  8 bytes, 1, 2, 3, ... of that process
//   time      8 bytes, microseconds since the Unix epoch when it was sent
//   tag      16 bytes, BLAKE2b keyed with the bus's key, over the channel's name and length, the message and the above
//   magic     4 bytes, "ONS1"
//
// One key for the whole bus: it keeps out who has no key, it does not tell the boards apart. Nothing is encrypted.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <map>
#include <string>
#include <utility>
#include <vector>

namespace orthonav {

using BusKey = std::array<uint8_t, 32>;

// Reads 64 hexadecimal digits. Throws std::runtime_error naming the file when it is missing, is something else, or can
// be read by everybody.
BusKey read_bus_key(const std::filesystem::path& file);

inline constexpr size_t kSealBytes = 44;

// Seals what one process sends. Not thread-safe.
class Sealer {
 public:
  // Throws std::runtime_error when libsodium does not start.
  explicit Sealer(const BusKey& key);
  // Appends the trailer. `now` in microseconds since the epoch.
  void seal(const std::string& channel, int64_t now, std::vector<uint8_t>& message);

 private:
  BusKey key_;
  uint64_t sender_ = 0;
  uint64_t sequence_ = 0;
};

// Judges what one subscription of a process receives: it takes a message that it is shown twice for a replay. Not
// thread-safe.
class SealChecker {
 public:
  explicit SealChecker(const BusKey& key);

  // Why the message is refused; empty when it may pass. Refused: no trailer, a wrong tag, a time more than 10 s from
  // `now` (the boards' clocks have to agree that well), a sequence number of the sender seen before on this channel, or
  // older than the newest by 64 or more. Messages that overtake each other pass.
  std::string refusal(const std::string& channel, int64_t now, const uint8_t* message, size_t size);

 private:
  struct Seen {
    uint64_t newest = 0;
    uint64_t before = 0;  // bit i: newest - i was seen
    int64_t time = 0;     // of the last message
  };
  BusKey key_;
  std::map<std::pair<std::string, uint64_t>, Seen> seen_;  // by channel and sender
};

}  // namespace orthonav
