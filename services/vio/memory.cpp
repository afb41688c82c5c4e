#include "services/vio/memory.h"

#include "common/memory/memory_file.h"

namespace orthonav::vio {
namespace {

constexpr uint64_t kVersion = 0x6f6e766d656d3031;  // "onvmem01"

}  // namespace

bool write_memory(const std::filesystem::path& file, const Memory& memory) {
  const Eigen::Vector3d& bias = memory.gyro_bias;
  return write_memory_file(
      file, kVersion,
      {{memory.utime},
       {memory.height, memory.height_stddev, memory.climb, bias.x(), bias.y(), bias.z(), memory.time_offset}});
}

std::optional<Memory> read_memory(const std::filesystem::path& file) {
  const auto image = read_memory_file(file, kVersion, 1, 7);
  if (!image) return std::nullopt;
  const std::vector<double>& reals = image->reals;
  Memory memory;
  memory.utime = image->integers[0];
  memory.height = reals[0];
  memory.height_stddev = reals[1];
  memory.climb = reals[2];
  memory.gyro_bias = {reals[3], reals[4], reals[5]};
  memory.time_offset = reals[6];
  return memory;
}

}  // namespace orthonav::vio
