#include "services/vio/missed_images.h"

#include <limits>
#include <random>

#include <gtest/gtest.h>

namespace orthonav::vio {
namespace {

constexpr int64_t kPeriod = 100'000;

// Ten images that all arrive; returns the time of the last.
int64_t begin(MissedImages& images) {
  int64_t utime = 1'700'000'000'000'000;
  for (int i = 0; i < 10; ++i) EXPECT_EQ(images.add(utime += kPeriod), 0);
  return utime;
}

TEST(MissedImages, CountsThoseOfAGap) {
  MissedImages images;
  int64_t utime = begin(images);
  EXPECT_EQ(images.add(utime += 2 * kPeriod), 1);
  EXPECT_EQ(images.add(utime += kPeriod), 0);
  EXPECT_EQ(images.add(utime += 5 * kPeriod), 4);
  EXPECT_EQ(images.add(utime += kPeriod), 0);
}

TEST(MissedImages, CountsALossOfEveryFifthOverAWholeFlight) {
  MissedImages images;
  int64_t utime = begin(images);
  std::mt19937 random(1);
  std::bernoulli_distribution lost(0.2);
  int counted = 0, missing = 0, last_gap = 0;
  for (int i = 0; i < 1000; ++i) {
    utime += kPeriod;
    if (lost(random)) {
      ++last_gap;
      continue;
    }
    counted += images.add(utime);
    missing += last_gap;
    last_gap = 0;
  }
  EXPECT_GT(missing, 150);
  EXPECT_NEAR(counted, missing, 0.1 * missing);
}

TEST(MissedImages, JitterOfATenthIsNoLoss) {
  MissedImages images;
  const int64_t start = begin(images);
  std::mt19937 random(2);
  std::uniform_int_distribution<int64_t> jitter(-kPeriod / 10, kPeriod / 10);
  for (int i = 1; i < 1000; ++i) EXPECT_EQ(images.add(start + i * kPeriod + jitter(random)), 0);
}

TEST(MissedImages, AnotherRateIsLossForAMomentOnly) {
  for (const int64_t period : {2 * kPeriod, kPeriod / 2}) {
    MissedImages images;
    int64_t utime = begin(images);
    int counted = 0;
    for (int i = 0; i < 100; ++i) counted += images.add(utime += period);
    EXPECT_LE(counted, period > kPeriod ? 5 : 0);
  }
}

TEST(MissedImages, AStoppedCameraAndATimeThatGoesBackAreNoLoss) {
  MissedImages images;
  int64_t utime = begin(images);
  EXPECT_EQ(images.add(utime += 30 * kPeriod), 0);
  EXPECT_EQ(images.add(utime += kPeriod), 0);
  EXPECT_EQ(images.add(utime -= 3'600'000'000), 0);
  EXPECT_EQ(images.add(utime += kPeriod), 0);
  for (const int64_t forged : {std::numeric_limits<int64_t>::min(), std::numeric_limits<int64_t>::max()}) {
    EXPECT_EQ(images.add(forged), 0);
    EXPECT_EQ(images.add(utime += kPeriod), 0);
  }
}

}  // namespace
}  // namespace orthonav::vio
