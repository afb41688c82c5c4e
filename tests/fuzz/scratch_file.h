// A file or folder in memory for readers that want one. Each fuzzing process has its own.
#pragma once

#include <cstdint>
#include <filesystem>
#include <fstream>
#include <string>

#include <unistd.h>

namespace orthonav::fuzz {

inline std::filesystem::path scratch_folder() {
  static const std::filesystem::path kFolder = [] {
    const auto base = std::filesystem::exists("/dev/shm") ? std::filesystem::path("/dev/shm")
                                                          : std::filesystem::temp_directory_path();
    auto folder = base / ("orthonav-fuzz-" + std::to_string(getpid()));
    std::filesystem::create_directories(folder);
    return folder;
  }();
  return kFolder;
}

inline std::filesystem::path scratch_file(const std::filesystem::path& name, const void* data, size_t size) {
  auto file = scratch_folder() / name;
  std::ofstream(file, std::ios::binary | std::ios::trunc)
      .write(static_cast<const char*>(data), static_cast<std::streamsize>(size));
  return file;
}

}  // namespace orthonav::fuzz
