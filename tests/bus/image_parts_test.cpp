#include "common/bus/image_parts.h"

#include <algorithm>
#include <cstring>
#include <limits>
#include <random>

#include <gtest/gtest.h>

#include "common/bus/channels.h"
#include "common/bus/packet.h"

namespace orthonav {
namespace {

constexpr int kWidth = 640, kHeight = 512;
constexpr int64_t kTime = 1'700'000'000'000'000;

image_t image_of(int size, int64_t utime = kTime) {
  image_t image{};
  image.utime = utime;
  image.width = kWidth;
  image.height = kHeight;
  image.pixelformat = image_t::PIXEL_FORMAT_MJPEG;
  image.size = size;
  std::mt19937 random(1);
  for (int i = 0; i < size; ++i) image.data.push_back(static_cast<uint8_t>(random()));
  return image;
}

void expect_same(const image_t& found, const image_t& image) {
  EXPECT_EQ(found.utime, image.utime);
  EXPECT_EQ(found.width, image.width);
  EXPECT_EQ(found.height, image.height);
  EXPECT_EQ(found.row_stride, image.row_stride);
  EXPECT_EQ(found.pixelformat, image.pixelformat);
  EXPECT_EQ(found.size, image.size);
  EXPECT_EQ(found.data, image.data);
}

TEST(ImageParts, AreTheImageAgainInWhateverOrderTheyCome) {
  std::mt19937 random(2);
  for (const int size : {1, 2, 1279, 1280, 1281, 80'000, kWidth * kHeight}) {
    image_t image = image_of(size);
    if (size == kWidth * kHeight) {
      image.pixelformat = image_t::PIXEL_FORMAT_GRAY;
      image.row_stride = kWidth;
    }
    std::vector<keyframe_image_t> parts = parts_of(image);
    std::shuffle(parts.begin(), parts.end(), random);
    ImageAssembler assembler(kWidth, kHeight);
    for (const keyframe_image_t& part : parts) {
      EXPECT_FALSE(assembler.has(kTime));
      EXPECT_TRUE(assembler.add(part));
    }
    EXPECT_TRUE(assembler.has(kTime));
    ASSERT_EQ(assembler.find(kTime).size(), 1U);
    expect_same(assembler.find(kTime).front(), image);
  }
}

TEST(ImageParts, AreOnePacketEach) {
  constexpr size_t kSeal = 44;  // of the authenticated mode, behind the message
  for (const keyframe_image_t& part : parts_of(image_of(10 * keyframe_image_t::PART_BYTES))) {
    EXPECT_LE(static_cast<size_t>(part.getEncodedSize()) + std::strlen(channel::kKeyframeImage) + 1 + kSeal,
              static_cast<size_t>(kPacketBytes));
  }
  EXPECT_TRUE(parts_of(image_of(0)).empty());
}

TEST(ImageParts, SentTwiceWithAHundredthLostAllArriveNinetyNineTimesInAHundred) {
  std::mt19937 random(3);
  std::uniform_int_distribution<int> hundredth(0, 99);
  ImageAssembler assembler(kWidth, kHeight);
  int whole = 0;
  constexpr int kImages = 1000;
  for (int k = 0; k < kImages; ++k) {
    const int64_t utime = kTime + k;
    const std::vector<keyframe_image_t> parts = parts_of(image_of(76'800, utime));
    for (int time = 0; time < 2; ++time) {
      for (const keyframe_image_t& part : parts) {
        if (hundredth(random) != 0) assembler.add(part);
      }
    }
    if (assembler.has(utime)) ++whole;
  }
  EXPECT_GE(whole, 985);  // 994 are expected, give or take 2.4
}

TEST(ImageParts, OfWhichOneIsMissingAreNoImage) {
  ImageAssembler assembler(kWidth, kHeight);
  EXPECT_EQ(assembler.describe(kTime), "no part came");
  const std::vector<keyframe_image_t> parts = parts_of(image_of(5000));
  ASSERT_EQ(parts.size(), 4U);
  for (const size_t k : {0, 1, 3}) assembler.add(parts[k]);
  EXPECT_TRUE(assembler.add(parts[3]));
  EXPECT_FALSE(assembler.has(kTime));
  EXPECT_TRUE(assembler.find(kTime).empty());
  EXPECT_EQ(assembler.describe(kTime), "3 of 4 parts came");
  EXPECT_TRUE(assembler.add(parts[2]));
  EXPECT_TRUE(assembler.has(kTime));
  EXPECT_FALSE(assembler.has(kTime + 1));
}

TEST(ImageParts, ThatCannotBeAreRefused) {
  ImageAssembler assembler(kWidth, kHeight);
  const keyframe_image_t good = parts_of(image_of(5000))[1];
  const auto refused = [&](auto&& change) {
    keyframe_image_t part = good;
    change(part);
    return !assembler.add(part);
  };
  constexpr int kLargest = std::numeric_limits<int32_t>::max(), kSmallest = std::numeric_limits<int32_t>::min();
  for (const int number : {kLargest, kSmallest, -1, 0}) {
    EXPECT_TRUE(refused([&](auto& part) { part.width = number; })) << number;
    EXPECT_TRUE(refused([&](auto& part) { part.height = number; })) << number;
    EXPECT_TRUE(refused([&](auto& part) { part.size = number; })) << number;
    EXPECT_TRUE(refused([&](auto& part) { part.num_bytes = number; })) << number;
    if (number == 0) continue;
    EXPECT_TRUE(refused([&](auto& part) { part.part = number; })) << number;
  }
  EXPECT_TRUE(refused([](auto& part) { part.part = 4; }));
  EXPECT_TRUE(refused([](auto& part) { part.part = 3; }));  // which is shorter
  EXPECT_TRUE(refused([](auto& part) { part.size = 8 * kWidth * kHeight + 65537; }));
  EXPECT_TRUE(refused([](auto& part) { part.data.pop_back(); }));
  EXPECT_TRUE(assembler.add(good));
}

TEST(ImageParts, ThatAreForgedHideNoImageAndFillNoMemory) {
  ImageAssembler assembler(kWidth, kHeight);
  const image_t image = image_of(5000), forged = image_of(100);
  // Two others of the same time, of which one is whole; and a stamp from tomorrow.
  assembler.add(parts_of(image_of(4000)).front());
  for (const keyframe_image_t& part : parts_of(forged)) assembler.add(part);
  for (const keyframe_image_t& part : parts_of(image_of(3000, kTime + 86'400'000'000))) assembler.add(part);
  for (const keyframe_image_t& part : parts_of(image)) assembler.add(part);
  ASSERT_EQ(assembler.find(kTime).size(), 2U);
  expect_same(assembler.find(kTime)[0], forged);
  expect_same(assembler.find(kTime)[1], image);
  // The last 32 are kept.
  for (int k = 1; k <= 31; ++k) assembler.add(parts_of(image_of(2000, kTime + k)).front());
  EXPECT_TRUE(assembler.has(kTime));
  assembler.add(parts_of(image_of(2000, kTime + 32)).front());
  EXPECT_FALSE(assembler.has(kTime));
}

}  // namespace
}  // namespace orthonav
