// A map database (.onmap). The checksums are put right, so that the fuzzer gets behind them: what is tried is a file
// that somebody wrote on purpose.
#include <cstring>
#include <vector>

#include "services/map_server/map_database.h"
#include "tests/fuzz/scratch_file.h"

namespace {

namespace onmap = orthonav::map_server::onmap;

// As in map_database.cpp.
constexpr size_t kHeader = 80, kLevel = 120, kTile = 24;
constexpr size_t kFileBytes = 16, kNumLevels = 48, kLevelsSum = 56, kIndexSum = 64, kHeaderSum = 72;
constexpr size_t kColumns = 104, kRows = 108;  // in a level

template <class T>
T at(const std::vector<uint8_t>& bytes, size_t position) {
  T value{};
  std::memcpy(&value, bytes.data() + position, sizeof(T));
  return value;
}
void put(std::vector<uint8_t>& bytes, size_t position, uint64_t value) {
  std::memcpy(bytes.data() + position, &value, sizeof(value));
}

void put_sums_right(std::vector<uint8_t>& bytes) {
  if (bytes.size() < kHeader) return;
  put(bytes, kFileBytes, bytes.size());
  const auto levels = at<int32_t>(bytes, kNumLevels);
  if (levels >= 1 && levels <= 16 && kHeader + kLevel * static_cast<size_t>(levels) <= bytes.size()) {
    const size_t index = kHeader + kLevel * static_cast<size_t>(levels);
    put(bytes, kLevelsSum, onmap::checksum_of(bytes.data() + kHeader, index - kHeader));
    uint64_t tiles = 0;
    for (size_t level = kHeader; level < index; level += kLevel)
      tiles += uint64_t{at<uint32_t>(bytes, level + kColumns)} * at<uint32_t>(bytes, level + kRows) % (1U << 30);
    if (tiles <= (bytes.size() - index) / kTile) {
      for (uint64_t i = 0; i < tiles; ++i) {
        const size_t entry = index + i * kTile;
        const auto offset = at<uint64_t>(bytes, entry), count = at<uint64_t>(bytes, entry + 8);
        if (count < bytes.size() && offset < bytes.size() && count * onmap::kFeatureBytes <= bytes.size() - offset)
          put(bytes, entry + 16, onmap::checksum_of(bytes.data() + offset, count * onmap::kFeatureBytes));
      }
      put(bytes, kIndexSum, onmap::checksum_of(bytes.data() + index, tiles * kTile));
    }
  }
  put(bytes, kHeaderSum, onmap::checksum_of(bytes.data(), kHeaderSum));
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  std::vector<uint8_t> bytes(data, data + size);
  put_sums_right(bytes);
  try {
    const orthonav::map_server::MapDatabase database(
        orthonav::fuzz::scratch_file("map.onmap", bytes.data(), bytes.size()));
    database.verify();
    for (size_t level = 0; level < database.levels().size(); ++level) {
      database.levels()[level].tile_of(10, 10);
      database.all_tiles(static_cast<int>(level));
    }
  } catch (const orthonav::map_server::MapDatabaseError&) {
    // The only thing that a file may do.
  }
  return 0;
}
