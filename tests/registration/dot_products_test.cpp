#include "services/registration/submap/dot_products.h"

#include <algorithm>
#include <array>
#include <random>

#include <gtest/gtest.h>
#include <opencv2/core.hpp>

#include "common/features/orientation_field.h"

namespace orthonav::registration {
namespace {

TEST(DotProducts, AreThoseOfTheDefinitionWhateverTheWidth) {
  cv::RNG random(3);
  cv::Mat bytes(200, kSiftBytes, CV_8U);
  random.fill(bytes, cv::RNG::UNIFORM, 0, 256);
  for (int i = 0; i + 1 < bytes.rows; ++i) {
    int64_t expected = 0;
    for (int k = 0; k < kSiftBytes; ++k) expected += bytes.at<uchar>(i, k) * bytes.at<uchar>(i + 1, k);
    EXPECT_EQ(dot_product(bytes.ptr(i), bytes.ptr(i + 1)), expected);
  }
  const std::vector<int> which{7, -1, 0, 199};
  std::vector<int> found(which.size());
  dot_products(bytes.ptr(3), bytes.ptr(), which.data(), which.size(), found.data());
  for (size_t i = 0; i < which.size(); ++i) {
    EXPECT_EQ(found[i], which[i] < 0 ? 0 : dot_product(bytes.ptr(3), bytes.ptr(which[i])));
  }
  for (const int columns : {1, 63, 64, 65, 200}) {
    cv::Mat row(kCoarseBytes / 2, 2 * columns, CV_8U);
    random.fill(row, cv::RNG::UNIFORM, 0, 46);  // 32 products of at most 45 * 22 fit
    cv::Mat query(1, kCoarseBytes, CV_8U);
    random.fill(query, cv::RNG::UNIFORM, 0, 23);
    const int first = columns / 3;
    std::vector<uint16_t> products(static_cast<size_t>(columns - first));
    coarse_products(query.ptr(), row.ptr() + static_cast<ptrdiff_t>(2 * first), static_cast<size_t>(columns),
                    products.size(), products.data());
    for (int i = first; i < columns; ++i) {
      int expected = 0;
      for (int k = 0; k < kCoarseBytes; ++k) {
        expected += query.at<uchar>(0, k) * row.at<uchar>(k / 2, 2 * i + k % 2);
      }
      EXPECT_EQ(products[static_cast<size_t>(i - first)], expected) << columns;
    }
  }
}

TEST(DotProducts, WhatTheySayAndItsSumsAreThoseOfTheDefinitionWhateverTheWidth) {
  std::mt19937 random(5);
  std::uniform_int_distribution<int> word(0, 30000), byte(0, 255);
  std::uniform_real_distribution<float> real(0.0F, 1.0F);
  const EvidenceLine line{15000, 0.01F, 0.5F, 4};
  const float levels = 255 / 16.0F;
  for (const size_t count : {0, 1, 15, 16, 33, 200}) {
    std::vector<uint16_t> products(count), words(count), more(count), most(count), sums;
    std::vector<uint8_t> bytes(count), weights(count);
    std::vector<float> scales(count), offsets(count), values(count), float_sums;
    std::vector<int32_t> wide(count);
    std::vector<int> which(count);
    std::vector<MapIndex::Centring> centring(7);
    for (auto& each : centring) each = {real(random), 20 * real(random)};
    for (size_t i = 0; i < count; ++i) {
      products[i] = static_cast<uint16_t>(word(random));
      wide[i] = 5 * word(random) - 60000;
      words[i] = static_cast<uint16_t>(word(random));
      more[i] = static_cast<uint16_t>(word(random));
      bytes[i] = static_cast<uint8_t>(byte(random));
      scales[i] = 0.1F * real(random);
      offsets[i] = 100 * real(random);
      which[i] = byte(random) % 8 - 1;
    }
    evidence_of(products.data(), scales.data(), offsets.data(), count, line, levels, weights.data());
    evidence_of(wide.data(), which.data(), centring.data(), count, line, values.data());
    sums = words;
    add(bytes.data(), count, sums.data());
    float_sums = scales;
    add(words.data(), 0.25F, count, float_sums.data());
    largest_of(words.data(), more.data(), products.data(), count, most.data());
    for (size_t i = 0; i < count; ++i) {
      const float said = levels * line.evidence(products[i], scales[i], offsets[i]);
      EXPECT_NEAR(weights[i], said, 0.5001) << i << " of " << count;
      const auto feature = static_cast<size_t>(std::max(0, which[i]));
      const float expected =
          which[i] < 0 ? 0
                       : line.evidence(static_cast<float>(wide[i]), centring[feature].scale, centring[feature].offset);
      EXPECT_EQ(values[i], expected) << i << " of " << count;
      EXPECT_EQ(sums[i], words[i] + bytes[i]);
      EXPECT_EQ(float_sums[i], scales[i] + 0.25F * words[i]);
      EXPECT_EQ(most[i], std::max({words[i], more[i], products[i]}));
    }
  }
}

TEST(DotProducts, AQuadraticFormIsThatOfTheWholeMatrix) {
  std::srand(3);
  for (const int size : {32, 64, 128}) {
    const Eigen::MatrixXf half = Eigen::MatrixXf::Random(size, size);
    const Eigen::MatrixXf matrix = half + half.transpose();
    const Eigen::VectorXf vector = Eigen::VectorXf::Random(size);
    const double expected = vector.cast<double>().dot(matrix.cast<double>() * vector.cast<double>());
    EXPECT_NEAR(quadratic_form(vector.data(), matrix.data(), static_cast<size_t>(size)), expected, 1e-4 * size);
  }
}

TEST(DotProducts, OfCoarseDescriptorsFitIntoFifteenBits) {
  // The two extremes: all in one component, and evenly spread.
  for (const int used : {1, 3, 128}) {
    std::array<uint8_t, kSiftBytes> descriptor{};
    for (int i = 0; i < used; ++i) {
      descriptor[static_cast<size_t>(i)] = static_cast<uint8_t>(std::min(255.0, kRootSiftLength / std::sqrt(used)));
    }
    std::array<uint8_t, kCoarseBytes> coarse{}, query{};
    coarsen(descriptor.data(), kCoarseLength, coarse.data());
    coarsen(descriptor.data(), kCoarseQueryLength, query.data());
    int product = 0;
    for (size_t k = 0; k < coarse.size(); ++k) {
      EXPECT_LT(query[k], 128);
      product += coarse[k] * query[k];
    }
    EXPECT_LT(product, 1 << 15);
    EXPECT_GT(product, 25000);
  }
}

}  // namespace
}  // namespace orthonav::registration
