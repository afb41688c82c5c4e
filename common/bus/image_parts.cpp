#include "common/bus/image_parts.h"

#include <algorithm>
#include <cstddef>
#include <iterator>
#include <tuple>
#include <utility>

#include <fmt/format.h>

#include "common/bus/packet.h"

namespace orthonav {
namespace {

constexpr int kPartBytes = keyframe_image_t::PART_BYTES;
// The part's other fields, the channel's name and a seal.
static_assert(kPartBytes + 44 + 15 + 44 <= kPacketBytes);
constexpr size_t kMostImages = 32;
// Bytes of an image: rows may be padded, JPEGs have tables.
constexpr int64_t kMostBytesPerPixel = 8, kLargestHeader = 65536;

int num_parts(const keyframe_image_t& part) {
  return static_cast<int>((int64_t{part.size} + kPartBytes - 1) / kPartBytes);
}

auto image_of(const keyframe_image_t& part) {
  return std::tie(part.utime, part.width, part.height, part.row_stride, part.pixelformat, part.size);
}

}  // namespace

std::vector<keyframe_image_t> parts_of(const image_t& image) {
  keyframe_image_t part{};
  part.utime = image.utime;
  part.width = image.width;
  part.height = image.height;
  part.row_stride = image.row_stride;
  part.pixelformat = image.pixelformat;
  part.size = static_cast<int32_t>(image.data.size());
  std::vector<keyframe_image_t> parts;
  for (auto begin = image.data.begin(); begin != image.data.end(); begin += part.num_bytes, ++part.part) {
    part.num_bytes = static_cast<int32_t>(std::min<std::ptrdiff_t>(kPartBytes, image.data.end() - begin));
    part.data.assign(begin, begin + part.num_bytes);
    parts.push_back(part);
  }
  return parts;
}

bool ImageAssembler::is_sound(const keyframe_image_t& part) const {
  if (part.width != width_ || part.height != height_) return false;
  if (part.size < 1 || part.size > kMostBytesPerPixel * width_ * height_ + kLargestHeader) return false;
  if (part.part < 0 || part.part >= num_parts(part)) return false;
  return part.num_bytes == std::min(kPartBytes, part.size - part.part * kPartBytes) &&
         part.data.size() == static_cast<size_t>(part.num_bytes);
}

bool ImageAssembler::add(const keyframe_image_t& part) {
  if (!is_sound(part)) return false;
  const auto is_its_own = [&](const Assembly& assembly) { return image_of(assembly.first) == image_of(part); };
  auto found = std::find_if(assemblies_.begin(), assemblies_.end(), is_its_own);
  if (found == assemblies_.end()) {
    if (assemblies_.size() == kMostImages) assemblies_.pop_front();
    Assembly assembly;
    assembly.first = part;
    assembly.first.data.clear();
    assembly.missing = static_cast<size_t>(num_parts(part));
    assembly.parts.resize(assembly.missing);
    assemblies_.push_back(std::move(assembly));
    found = std::prev(assemblies_.end());
  }
  std::vector<uint8_t>& bytes = found->parts[static_cast<size_t>(part.part)];
  if (!bytes.empty()) return true;
  bytes = part.data;
  --found->missing;
  return true;
}

std::vector<image_t> ImageAssembler::find(int64_t utime) const {
  std::vector<image_t> images;
  for (const Assembly& assembly : assemblies_) {
    if (assembly.first.utime != utime || assembly.missing > 0) continue;
    image_t image{};
    image.utime = utime;
    image.width = assembly.first.width;
    image.height = assembly.first.height;
    image.row_stride = assembly.first.row_stride;
    image.pixelformat = assembly.first.pixelformat;
    image.size = assembly.first.size;
    for (const std::vector<uint8_t>& bytes : assembly.parts) {
      image.data.insert(image.data.end(), bytes.begin(), bytes.end());
    }
    images.push_back(std::move(image));
  }
  return images;
}

bool ImageAssembler::has(int64_t utime) const {
  return std::any_of(assemblies_.begin(), assemblies_.end(),
                     [&](const Assembly& assembly) { return assembly.first.utime == utime && assembly.missing == 0; });
}

std::string ImageAssembler::describe(int64_t utime) const {
  const auto is_of_that_time = [&](const Assembly& assembly) { return assembly.first.utime == utime; };
  const auto found = std::find_if(assemblies_.begin(), assemblies_.end(), is_of_that_time);
  if (found == assemblies_.end()) return "no part came";
  return fmt::format("{} of {} parts came", found->parts.size() - found->missing, found->parts.size());
}

}  // namespace orthonav
