#include "common/bus/seal.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <fstream>
#include <stdexcept>

#include <fmt/format.h>
#include <sodium.h>
#include <sys/stat.h>

namespace orthonav {

namespace {

constexpr int64_t kOldest = 10'000'000;  // microseconds
constexpr uint64_t kWindow = 64;
// A sender is a run of a process. Only holders of the key get into the table, so a bound is against leaks, not attacks.
constexpr size_t kMostSenders = 1000;
constexpr size_t kTagBytes = 16;
constexpr std::array<uint8_t, 4> kMagic{'O', 'N', 'S', '1'};

// Byte by byte, so that boards of either endianness agree.
void append(std::vector<uint8_t>& bytes, uint64_t value) {
  for (int i = 0; i < 8; ++i) bytes.push_back(static_cast<uint8_t>(value >> (8 * i)));
}
uint64_t number_at(const uint8_t* bytes) {
  uint64_t value = 0;
  for (int i = 7; i >= 0; --i) value = value << 8 | bytes[i];
  return value;
}

std::array<uint8_t, kTagBytes> tag_of(const BusKey& key, const std::string& channel, const uint8_t* bytes,
                                      size_t size) {
  crypto_generichash_state state;
  crypto_generichash_init(&state, key.data(), key.size(), kTagBytes);
  std::vector<uint8_t> head(channel.begin(), channel.end());
  append(head, channel.size());
  append(head, size);
  crypto_generichash_update(&state, head.data(), head.size());
  crypto_generichash_update(&state, bytes, size);
  std::array<uint8_t, kTagBytes> tag{};
  crypto_generichash_final(&state, tag.data(), tag.size());
  return tag;
}

}  // namespace

BusKey read_bus_key(const std::filesystem::path& file) {
  struct stat status {};
  std::ifstream stream(file);
  std::string text;
  if (!(stream >> text) || stat(file.c_str(), &status) != 0)
    throw std::runtime_error(fmt::format("{}: cannot be read as the bus's key", file.string()));
  if ((status.st_mode & S_IROTH) != 0)
    throw std::runtime_error(
        fmt::format("{}: everybody can read this key: chmod o-r {}", file.string(), file.string()));
  BusKey key{};
  size_t length = 0;
  const int result = sodium_hex2bin(key.data(), key.size(), text.data(), text.size(), nullptr, &length, nullptr);
  if (result != 0 || length != key.size() || text.size() != 2 * key.size()) {
    throw std::runtime_error(
        fmt::format("{}: a key is 64 hexadecimal digits: od -An -tx1 -N32 /dev/urandom | tr -d ' \\n'", file.string()));
  }
  return key;
}

Sealer::Sealer(const BusKey& key) : key_(key) {
  if (sodium_init() < 0) throw std::runtime_error("libsodium does not start");
  randombytes_buf(&sender_, sizeof(sender_));
}

void Sealer::seal(const std::string& channel, int64_t now, std::vector<uint8_t>& message) {
  message.reserve(message.size() + kSealBytes);
  append(message, sender_);
  append(message, ++sequence_);
  append(message, static_cast<uint64_t>(now));
  const auto tag = tag_of(key_, channel, message.data(), message.size());
  message.insert(message.end(), tag.begin(), tag.end());
  message.insert(message.end(), kMagic.begin(), kMagic.end());
}

SealChecker::SealChecker(const BusKey& key) : key_(key) {
  if (sodium_init() < 0) throw std::runtime_error("libsodium does not start");
}

std::string SealChecker::refusal(const std::string& channel, int64_t now, const uint8_t* message, size_t size) {
  if (size < kSealBytes || std::memcmp(message + size - kMagic.size(), kMagic.data(), kMagic.size()) != 0)
    return "is not sealed";
  const size_t tag_at = size - kMagic.size() - kTagBytes;
  if (sodium_memcmp(tag_of(key_, channel, message, tag_at).data(), message + tag_at, kTagBytes) != 0)
    return "is sealed with another key, or was changed";
  const uint64_t sender = number_at(message + tag_at - 24), sequence = number_at(message + tag_at - 16);
  const auto time = static_cast<int64_t>(number_at(message + tag_at - 8));
  if (std::abs(static_cast<double>(now) - static_cast<double>(time)) > kOldest) {
    return fmt::format("was sealed {:.1f} s ago: a replay, or is chrony not running on both boards?",
                       1e-6 * (static_cast<double>(now) - static_cast<double>(time)));
  }
  if (seen_.size() >= kMostSenders && !seen_.contains({channel, sender})) {
    const auto oldest =
        std::min_element(seen_.begin(), seen_.end(), [](auto& a, auto& b) { return a.second.time < b.second.time; });
    seen_.erase(oldest);
  }
  Seen& seen = seen_[{channel, sender}];
  seen.time = std::max(seen.time, time);
  if (sequence > seen.newest) {
    const uint64_t step = sequence - seen.newest;
    seen.before = (step >= kWindow ? 0 : seen.before << step) | 1;
    seen.newest = sequence;
    return "";
  }
  const uint64_t back = seen.newest - sequence;
  if (back >= kWindow || (seen.before >> back & 1) != 0) return "was heard before: a replay";
  seen.before |= uint64_t{1} << back;
  return "";
}

}  // namespace orthonav
