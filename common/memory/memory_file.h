// A few numbers that outlive a killed process: a small file, replaced as a whole, that its successor reads.
//
// Read by the machine that wrote it, seconds later. A file that is cut, altered, of another version or of another size
// is no memory. Whether the numbers make sense is the reader's to judge.
#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <optional>
#include <vector>

namespace orthonav {

struct MemoryImage {
  std::vector<int64_t> integers;
  std::vector<double> reals;
};

// Replaces the file. False, with the old file left as it was, where that cannot be done.
bool write_memory_file(const std::filesystem::path& file, uint64_t version, const MemoryImage& image);

// nullopt where there is no such file, or it is no memory of this version with so many numbers.
std::optional<MemoryImage> read_memory_file(const std::filesystem::path& file, uint64_t version, size_t integers,
                                            size_t reals);

}  // namespace orthonav
