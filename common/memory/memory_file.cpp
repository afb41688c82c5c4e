#include "common/memory/memory_file.h"

#include <bit>
#include <fstream>
#include <system_error>

namespace orthonav {
namespace {

// FNV-1a, 64 bits, of all words but the last.
uint64_t checksum_of(const std::vector<uint64_t>& words) {
  uint64_t hash = 0xcbf29ce484222325;
  for (size_t i = 0; i + 1 < words.size(); ++i) {
    for (int shift = 0; shift < 64; shift += 8) hash = (hash ^ (words[i] >> shift & 0xff)) * 0x100000001b3;
  }
  return hash;
}

}  // namespace

bool write_memory_file(const std::filesystem::path& file, uint64_t version, const MemoryImage& image) {
  std::vector<uint64_t> words{version};
  for (const int64_t integer : image.integers) words.push_back(std::bit_cast<uint64_t>(integer));
  for (const double real : image.reals) words.push_back(std::bit_cast<uint64_t>(real));
  words.push_back(0);
  words.back() = checksum_of(words);
  std::filesystem::path part = file;
  part += ".part";
  {
    std::ofstream stream(part, std::ios::binary | std::ios::trunc);
    stream.write(reinterpret_cast<const char*>(words.data()), static_cast<std::streamsize>(8 * words.size()));
    stream.close();
    if (!stream) return false;
  }
  std::error_code error;
  std::filesystem::rename(part, file, error);
  return !error;
}

std::optional<MemoryImage> read_memory_file(const std::filesystem::path& file, uint64_t version, size_t integers,
                                            size_t reals) {
  std::vector<uint64_t> words(2 + integers + reals);
  std::ifstream stream(file, std::ios::binary);
  stream.read(reinterpret_cast<char*>(words.data()), static_cast<std::streamsize>(8 * words.size()));
  if (!stream || stream.peek() != std::ifstream::traits_type::eof()) return std::nullopt;
  if (words.front() != version || words.back() != checksum_of(words)) return std::nullopt;
  MemoryImage image;
  for (size_t i = 0; i < integers; ++i) image.integers.push_back(std::bit_cast<int64_t>(words[1 + i]));
  for (size_t i = 0; i < reals; ++i) image.reals.push_back(std::bit_cast<double>(words[1 + integers + i]));
  return image;
}

}  // namespace orthonav
