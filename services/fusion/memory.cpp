#include "services/fusion/memory.h"

#include <array>
#include <cstring>
#include <fstream>
#include <system_error>

namespace orthonav::fusion {
namespace {

constexpr uint64_t kVersion = 0x6f6e61766d656d31;  // "onavmem1"
constexpr size_t kIntegers = 8;
constexpr size_t kReals = 11 + kStates + kStates * kStates;

// As it lies on the disk; read by the machine that wrote it, seconds later.
struct Image {
  uint64_t version = kVersion;
  std::array<int64_t, kIntegers> integers{};
  std::array<double, kReals> reals{};
  uint64_t checksum = 0;  // of all before
};
static_assert(sizeof(Image) == 8 * (2 + kIntegers + kReals), "no padding");

// FNV-1a, 64 bits.
uint64_t checksum_of(const Image& image) {
  std::array<unsigned char, sizeof(Image) - sizeof(image.checksum)> bytes{};
  std::memcpy(bytes.data(), &image, bytes.size());
  uint64_t hash = 0xcbf29ce484222325;
  for (const unsigned char byte : bytes) hash = (hash ^ byte) * 0x100000001b3;
  return hash;
}

}  // namespace

bool write_memory(const std::filesystem::path& file, const Memory& memory) {
  const Keyframe& keyframe = memory.keyframe;
  Image image;
  image.integers = {keyframe.utime,          keyframe.session, keyframe.id,         memory.session_utime,
                    memory.newest_fix_utime, memory.believed,  memory.reset_counter};
  double* out = image.reals.data();
  const auto put = [&out](double value) { *out++ = value; };
  for (const double value : keyframe.p_W_B) put(value);
  for (const double value : keyframe.q_W_B.coeffs()) put(value);
  put(keyframe.height_above_ground);
  for (const double value : {memory.anchor.latitude_deg, memory.anchor.longitude_deg, memory.anchor.height}) put(value);
  for (const double value : memory.estimate.state.x) put(value);
  for (const double value : memory.estimate.covariance.reshaped()) put(value);
  image.checksum = checksum_of(image);

  std::array<char, sizeof(Image)> bytes{};
  std::memcpy(bytes.data(), &image, bytes.size());
  std::filesystem::path part = file;
  part += ".part";
  {
    std::ofstream stream(part, std::ios::binary | std::ios::trunc);
    stream.write(bytes.data(), bytes.size());
    stream.close();
    if (!stream) return false;
  }
  std::error_code error;
  std::filesystem::rename(part, file, error);
  return !error;
}

std::optional<Memory> read_memory(const std::filesystem::path& file) {
  std::array<char, sizeof(Image) + 1> bytes{};  // one more, to see a file that is too long
  std::ifstream stream(file, std::ios::binary);
  stream.read(bytes.data(), bytes.size());
  if (stream.gcount() != static_cast<std::streamsize>(sizeof(Image))) return std::nullopt;
  Image image;
  std::memcpy(&image, bytes.data(), sizeof(Image));
  if (image.version != kVersion || image.checksum != checksum_of(image)) return std::nullopt;

  Memory memory;
  Keyframe& keyframe = memory.keyframe;
  keyframe.utime = image.integers[0];
  keyframe.session = static_cast<int>(image.integers[1]);
  keyframe.id = static_cast<int>(image.integers[2]);
  memory.session_utime = image.integers[3];
  memory.newest_fix_utime = image.integers[4];
  memory.believed = static_cast<int>(image.integers[5]);
  memory.reset_counter = static_cast<int>(image.integers[6]);
  const double* in = image.reals.data();
  const auto take = [&in] { return *in++; };
  for (double& value : keyframe.p_W_B) value = take();
  for (double& value : keyframe.q_W_B.coeffs()) value = take();
  keyframe.height_above_ground = take();
  for (double* value : {&memory.anchor.latitude_deg, &memory.anchor.longitude_deg, &memory.anchor.height}) {
    *value = take();
  }
  for (double& value : memory.estimate.state.x) value = take();
  for (double& value : memory.estimate.covariance.reshaped()) value = take();
  return memory;
}

}  // namespace orthonav::fusion
