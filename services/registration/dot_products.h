// Similarities of a descriptor to many: dot products of bytes, exact, with the widest instructions the machine has.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>

#include "services/registration/map_index.h"

namespace orthonav::registration {

// Product of two descriptors of kSiftBytes.
int32_t dot_product(const uint8_t* a, const uint8_t* b);

// out[i] = product of `query` with the descriptor of number which[i] of an array of them, 0 where that is negative.
void dot_products(const uint8_t* query, const uint8_t* descriptors, const int* which, size_t count, int32_t* out);

// out[i] = product of `query` (7 bits a component) with column i of a coarse row of the index, i < count. `row` points
// at the first column's first two components; the pairs of a column are 2 `stride` bytes apart.
void coarse_products(const uint8_t* query, const uint8_t* row, size_t stride, size_t count, uint16_t* out);

// What products say: out[i] = line.evidence(products[i], scales[i], offsets[i]).
struct EvidenceLine {
  float a = 0, b = 1, c = 0, most = 0;

  // Limited before it is squared: the other way round compilers make a branch of it, at six times the cost.
  float evidence(float product, float scale, float offset) const {
    const float excess = std::clamp(b * ((product - a) * scale - offset) - c, 0.0F, most);
    return excess * excess;
  }
};
void evidence_of(const uint16_t* products, const float* scales, const float* offsets, size_t count,
                 const EvidenceLine& line, float* out);

// sum[i] += values[i].
void add(const float* values, size_t count, float* sum);

}  // namespace orthonav::registration
