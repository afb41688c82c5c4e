#include "services/fusion/memory.h"

#include "common/memory/memory_file.h"

namespace orthonav::fusion {
namespace {

constexpr uint64_t kVersion = 0x6f6e61766d656d35;  // "onavmem5"
constexpr size_t kIntegers = 7;
constexpr size_t kReals = 16 + kStates + kStates * kStates;

}  // namespace

bool write_memory(const std::filesystem::path& file, const Memory& memory) {
  const Keyframe& keyframe = memory.keyframe;
  MemoryImage image;
  image.integers = {keyframe.utime,          keyframe.session, keyframe.id,         memory.session_utime,
                    memory.newest_fix_utime, memory.believed,  memory.reset_counter};
  const auto put = [&image](double value) { image.reals.push_back(value); };
  for (const double value : keyframe.p_W_B) put(value);
  for (const double value : keyframe.q_W_B.coeffs()) put(value);
  put(keyframe.height_above_ground);
  for (const double value : keyframe.levelled) put(value);
  put(keyframe.lean_stddev);
  for (const double value : {memory.anchor.latitude_deg, memory.anchor.longitude_deg, memory.anchor.height}) put(value);
  put(memory.most_told);
  put(memory.span);
  for (const double value : memory.estimate.state.x) put(value);
  for (const double value : memory.estimate.covariance.reshaped()) put(value);
  return write_memory_file(file, kVersion, image);
}

std::optional<Memory> read_memory(const std::filesystem::path& file) {
  const auto image = read_memory_file(file, kVersion, kIntegers, kReals);
  if (!image) return std::nullopt;
  Memory memory;
  Keyframe& keyframe = memory.keyframe;
  keyframe.utime = image->integers[0];
  keyframe.session = static_cast<int>(image->integers[1]);
  keyframe.id = static_cast<int>(image->integers[2]);
  memory.session_utime = image->integers[3];
  memory.newest_fix_utime = image->integers[4];
  memory.believed = static_cast<int>(image->integers[5]);
  memory.reset_counter = static_cast<int>(image->integers[6]);
  const double* in = image->reals.data();
  const auto take = [&in] { return *in++; };
  for (double& value : keyframe.p_W_B) value = take();
  for (double& value : keyframe.q_W_B.coeffs()) value = take();
  keyframe.height_above_ground = take();
  for (double& value : keyframe.levelled) value = take();
  keyframe.lean_stddev = take();
  for (double* value : {&memory.anchor.latitude_deg, &memory.anchor.longitude_deg, &memory.anchor.height}) {
    *value = take();
  }
  memory.most_told = take();
  memory.span = take();
  for (double& value : memory.estimate.state.x) value = take();
  for (double& value : memory.estimate.covariance.reshaped()) value = take();
  return memory;
}

}  // namespace orthonav::fusion
