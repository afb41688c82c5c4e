// A keyframe's image in parts of one packet each, and the image again from what arrives of them.
//
// Where a hundredth of the packets is lost, an image that is one message of sixty packets is lost every other time; of
// sixty parts that are each sent twice, all arrive in 99.4 of a hundred images.
#pragma once

#include <cstdint>
#include <deque>
#include <string>
#include <vector>

#include "orthonav/image_t.hpp"
#include "orthonav/keyframe_image_t.hpp"

namespace orthonav {

// The image, without its metadata, in parts of one packet. None of an image without data. Thread-safe.
std::vector<keyframe_image_t> parts_of(const image_t& image);

// Puts images together from parts that come in any order, more than once, or not at all; keeps the last 32. Parts that
// differ in what they say of the whole image are of different images. Memory is taken for what arrived only.
// Not thread-safe.
class ImageAssembler {
 public:
  // Of a camera of so many pixels.
  ImageAssembler(int width, int height) : width_(width), height_(height) {}

  // Takes the part, unless it is there already. False where its numbers do not agree with each other, or are not of an
  // image of this camera.
  bool add(const keyframe_image_t& part);

  // The whole images of that time, in the order in which their first parts came: more than one only where somebody
  // forges them.
  std::vector<image_t> find(int64_t utime) const;
  bool has(int64_t utime) const;

  // What there is of an image of that time, for people: "59 of 60 parts came".
  std::string describe(int64_t utime) const;

 private:
  struct Assembly {
    keyframe_image_t first;                   // the part that came first, without its bytes
    std::vector<std::vector<uint8_t>> parts;  // empty: not here yet
    size_t missing = 0;
  };
  bool is_sound(const keyframe_image_t& part) const;

  int width_, height_;
  std::deque<Assembly> assemblies_;  // by when their first parts came
};

}  // namespace orthonav
