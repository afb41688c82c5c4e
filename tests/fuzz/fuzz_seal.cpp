// The trailer of a sealed message, and key files: nothing but what the key's holder sealed may pass.
#include <cstdlib>
#include <stdexcept>
#include <vector>

#include "common/bus/seal.h"
#include "tests/fuzz/scratch_file.h"

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace orthonav;
  constexpr int64_t kNow = 1'700'000'000'000'000;
  const BusKey key{1, 2, 3};
  SealChecker checker(key);
  if (checker.refusal("IMU", kNow, data, size).empty()) std::abort();

  // A sealed message passes once; with one byte of it changed, as the input says, it does not.
  std::vector<uint8_t> message(data, data + size);
  Sealer(key).seal("IMU", kNow, message);
  if (size >= 3 && data[0] != 0) {
    std::vector<uint8_t> changed = message;
    changed[(data[1] * 256u + data[2]) % changed.size()] ^= data[0];
    if (checker.refusal("IMU", kNow, changed.data(), changed.size()).empty()) std::abort();
  }
  if (checker.refusal("CAMERA", kNow, message.data(), message.size()).empty()) std::abort();
  if (!checker.refusal("IMU", kNow, message.data(), message.size()).empty()) std::abort();
  if (checker.refusal("IMU", kNow, message.data(), message.size()).empty()) std::abort();

  const auto file = fuzz::scratch_file("bus.key", data, size);
  std::filesystem::permissions(file, std::filesystem::perms::owner_read | std::filesystem::perms::owner_write);
  try {
    read_bus_key(file);
  } catch (const std::runtime_error&) {
  }
  return 0;
}
