// Similarities of a descriptor to many: dot products of bytes, exact, with the widest instructions the machine has.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>

#include "services/registration/map/map_index.h"

namespace orthonav::registration {

// Product of two descriptors of kSiftBytes.
int32_t dot_product(const uint8_t* a, const uint8_t* b);

// out[i] = product of `query` with the descriptor of number which[i] of an array of them, 0 where that is negative.
void dot_products(const uint8_t* query, const uint8_t* descriptors, const int* which, size_t count, int32_t* out);

// out[i] = product of `query` (7 bits a component) with column i of a coarse row of the index, i < count. `row` points
// at the first column's first two components; the pairs of a column are 2 `stride` bytes apart.
void coarse_products(const uint8_t* query, const uint8_t* row, size_t stride, size_t count, uint16_t* out);

// What a product says.
struct EvidenceLine {
  float a = 0, b = 1, c = 0, most = 0;

  // Limited before it is squared: the other way round compilers make a branch of it, at six times the cost.
  float evidence(float product, float scale, float offset) const {
    const float excess = std::clamp(b * ((product - a) * scale - offset) - c, 0.0F, most);
    return excess * excess;
  }
};
// out[i] = levels * line.evidence(products[i], scales[i], offsets[i]), to the nearest; `levels` times the most that the
// line can say must not exceed 255.
void evidence_of(const uint16_t* products, const float* scales, const float* offsets, size_t count,
                 const EvidenceLine& line, float levels, uint8_t* out);

// out[i] = line.evidence(products[i], ...) of the feature of number which[i], 0 where that is negative.
void evidence_of(const int32_t* products, const int* which, const MapIndex::Centring* centring, size_t count,
                 const EvidenceLine& line, float* out);

// out[i] = the largest of a[i], b[i] and c[i].
void largest_of(const float* a, const float* b, const float* c, size_t count, float* out);
void largest_of(const uint16_t* a, const uint16_t* b, const uint16_t* c, size_t count, uint16_t* out);

// sum[i] += values[i].
void add(const float* values, size_t count, float* sum);
void add(const uint8_t* values, size_t count, uint16_t* sum);
// sum[i] += unit * values[i].
void add(const uint16_t* values, float unit, size_t count, float* sum);

// v' M v, M symmetric and size x size, a multiple of 32.
float quadratic_form(const float* vector, const float* matrix, size_t size);

}  // namespace orthonav::registration
