#include "common/camera/image_decode.h"

#include <algorithm>
#include <cstdint>
#include <optional>
#include <vector>

#include <fmt/format.h>
#include <opencv2/imgcodecs.hpp>

namespace orthonav {
namespace {

DecodedImage refuse(std::string why) {
  DecodedImage result;
  result.error = std::move(why);
  return result;
}

// libjpeg fills what a truncated file lacks with grey and only warns, so the end marker is asked for beforehand.
bool has_jpeg_markers(const std::vector<uint8_t>& data, size_t size) {
  if (size < 4 || data[0] != 0xFF || data[1] != 0xD8) return false;
  const size_t tail = std::min<size_t>(size, 64);  // some encoders pad the end with zeros
  for (size_t i = size - tail; i + 1 < size; ++i) {
    if (data[i] == 0xFF && data[i + 1] == 0xD9) return true;
  }
  return false;
}

// As the frame header says (ITU-T T.81, B.2.2), read before a decoder takes memory for it: 65535 x 65535 pixels fit
// into twenty bytes.
std::optional<cv::Size> jpeg_size(const std::vector<uint8_t>& data, size_t size) {
  const auto word = [&](size_t at) { return data[at] << 8 | data[at + 1]; };
  for (size_t at = 2; at + 9 <= size && data[at] == 0xFF;) {
    const uint8_t marker = data[at + 1];
    if (marker == 0xFF) {  // fill
      ++at;
      continue;
    }
    const bool has_length = marker >= 0xC0 && (marker < 0xD0 || marker > 0xD9);
    if (!has_length) return std::nullopt;
    const bool tables = marker == 0xC4 || marker == 0xC8 || marker == 0xCC;
    if (marker <= 0xCF && !tables) return cv::Size(word(at + 7), word(at + 5));
    at += 2 + static_cast<size_t>(word(at + 2));
  }
  return std::nullopt;
}

}  // namespace

DecodedImage decode_image(const image_t& image, int width, int height) {
  constexpr int kMaxSide = 1 << 15;
  if (image.width <= 0 || image.height <= 0 || image.width > kMaxSide || image.height > kMaxSide) {
    return refuse(fmt::format("image size {}x{} is not plausible", image.width, image.height));
  }
  if ((width > 0 && image.width != width) || (height > 0 && image.height != height)) {
    return refuse(
        fmt::format("image is {}x{}, the calibration is for {}x{}", image.width, image.height, width, height));
  }
  if (image.size <= 0 || image.data.size() < static_cast<size_t>(image.size)) {
    return refuse("image has no data");
  }
  DecodedImage result;
  if (image.pixelformat == image_t::PIXEL_FORMAT_GRAY) {
    if (image.row_stride < image.width) {
      return refuse(fmt::format("row stride {} is less than the width {}", image.row_stride, image.width));
    }
    const int64_t needed = int64_t{image.row_stride} * (image.height - 1) + image.width;
    if (image.size < needed) return refuse(fmt::format("image has {} bytes, its rows need {}", image.size, needed));
    result.grey.create(image.height, image.width, CV_8UC1);
    for (int row = 0; row < image.height; ++row) {
      const uint8_t* from = image.data.data() + int64_t{row} * image.row_stride;
      std::copy(from, from + image.width, result.grey.ptr<uint8_t>(row));
    }
    return result;
  }
  if (image.pixelformat == image_t::PIXEL_FORMAT_MJPEG) {
    const auto size = static_cast<size_t>(image.size);
    if (!has_jpeg_markers(image.data, size)) return refuse("JPEG is truncated or no JPEG");
    const auto coded = jpeg_size(image.data, size);
    if (!coded) return refuse("JPEG has no frame header");
    if (*coded != cv::Size(image.width, image.height)) {
      return refuse(
          fmt::format("JPEG is {}x{}, the message says {}x{}", coded->width, coded->height, image.width, image.height));
    }
    // The pixels as they lie on the sensor, whichever way up a tag would have them: so they were calibrated.
    constexpr int kFlags = cv::IMREAD_GRAYSCALE | cv::IMREAD_IGNORE_ORIENTATION;
    const cv::Mat buffer(1, image.size, CV_8UC1, const_cast<uint8_t*>(image.data.data()));  // only read
    try {
      result.grey = cv::imdecode(buffer, kFlags);
    } catch (const cv::Exception& error) {
      return refuse(fmt::format("JPEG does not decode: {}", error.err));
    }
    if (result.grey.size() != *coded) return refuse("JPEG does not decode");
    return result;
  }
  return refuse(fmt::format("pixel format {:#x} is not supported", image.pixelformat));
}

}  // namespace orthonav
