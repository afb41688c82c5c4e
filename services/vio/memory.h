// What a session that did not fail leaves to the next, also to that of another process: the height above ground hardly
// changes in the seconds between, and with it the scale need not wait for motion; the gyroscope's bias and the time
// offset do not change at all.
#pragma once

#include <cstdint>
#include <filesystem>
#include <optional>

#include <Eigen/Core>

namespace orthonav::vio {

struct Memory {
  int64_t utime = 0;                                    // of the keyframe it was true at, by the IMU's clock
  double height = 0, height_stddev = 0;                 // m above ground
  double climb = 0;                                     // m/s
  Eigen::Vector3d gyro_bias = Eigen::Vector3d::Zero();  // rad/s
  double time_offset = 0;                               // s
};

// As write_memory_file and read_memory_file (common/memory/memory_file.h).
bool write_memory(const std::filesystem::path& file, const Memory& memory);
std::optional<Memory> read_memory(const std::filesystem::path& file);

}  // namespace orthonav::vio
