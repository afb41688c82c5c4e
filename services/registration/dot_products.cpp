#include "services/registration/dot_products.h"

#include "common/features/fixed_sift.h"

// The same loops compiled for several instruction sets, the best of which is chosen at run time. What they compute is
// integers, or floats in an order that does not depend on the vectors' width: all give the same bits.
namespace orthonav::registration {
namespace {

#define ORTHONAV_INLINE inline __attribute__((always_inline))

ORTHONAV_INLINE int32_t dot_product_loop(const uint8_t* a, const uint8_t* b) {
  int32_t sum = 0;
  for (int i = 0; i < kSiftBytes; ++i) sum += static_cast<int16_t>(a[i]) * static_cast<int16_t>(b[i]);
  return sum;
}

ORTHONAV_INLINE void dot_products_loop(const uint8_t* query, const uint8_t* descriptors, const int* which, size_t count,
                                       int32_t* out) {
  int16_t wide[kSiftBytes];  // NOLINT: as below
  std::copy_n(query, kSiftBytes, wide);
  for (size_t i = 0; i < count; ++i) {
    out[i] = 0;
    if (which[i] < 0) continue;
    const uint8_t* descriptor = descriptors + static_cast<ptrdiff_t>(which[i]) * kSiftBytes;
    int32_t sum = 0;
    for (int k = 0; k < kSiftBytes; ++k) sum += wide[k] * static_cast<int16_t>(descriptor[k]);
    out[i] = sum;
  }
}

ORTHONAV_INLINE void coarse_products_loop(const uint8_t* query, const uint8_t* row, size_t stride, size_t count,
                                          uint16_t* out) {
  // Blocks that stay in registers while the components pass.
  constexpr size_t kBlock = 64;
  size_t first = 0;
  for (; first + kBlock <= count; first += kBlock) {
    uint16_t sums[kBlock] = {};  // NOLINT: a plain array is what the compiler keeps in registers
    for (size_t k = 0; k < kCoarseBytes; ++k) {
      const uint8_t* component = row + k * stride + first;
      const uint16_t factor = query[k];
      for (size_t i = 0; i < kBlock; ++i) {
        sums[i] = static_cast<uint16_t>(sums[i] + static_cast<uint16_t>(factor * component[i]));
      }
    }
    std::copy_n(sums, kBlock, out + first);
  }
  for (size_t i = first; i < count; ++i) {
    uint16_t sum = 0;
    for (size_t k = 0; k < kCoarseBytes; ++k) sum = static_cast<uint16_t>(sum + query[k] * row[k * stride + i]);
    out[i] = sum;
  }
}

ORTHONAV_INLINE void evidence_loop(const uint16_t* products, const float* scales, const float* offsets, size_t count,
                                   const EvidenceLine& line, float* out) {
  const EvidenceLine l = line;
  for (size_t i = 0; i < count; ++i) out[i] = l.evidence(products[i], scales[i], offsets[i]);
}

ORTHONAV_INLINE void add_loop(const float* values, size_t count, float* sum) {
  for (size_t i = 0; i < count; ++i) sum[i] += values[i];
}

struct Functions {
  int32_t (*dot_product)(const uint8_t*, const uint8_t*);
  void (*dot_products)(const uint8_t*, const uint8_t*, const int*, size_t, int32_t*);
  void (*coarse_products)(const uint8_t*, const uint8_t*, size_t, size_t, uint16_t*);
  void (*evidence)(const uint16_t*, const float*, const float*, size_t, const EvidenceLine&, float*);
  void (*add)(const float*, size_t, float*);
};

// One set of functions for an instruction set; `attribute` is the one that asks for it.
#define ORTHONAV_FUNCTIONS(suffix, attribute)                                                                       \
  __attribute__((attribute)) int32_t dot_product_##suffix(const uint8_t* a, const uint8_t* b) {                     \
    return dot_product_loop(a, b);                                                                                  \
  }                                                                                                                 \
  __attribute__((attribute)) void dot_products_##suffix(const uint8_t* query, const uint8_t* descriptors,           \
                                                        const int* which, size_t count, int32_t* out) {             \
    dot_products_loop(query, descriptors, which, count, out);                                                       \
  }                                                                                                                 \
  __attribute__((attribute)) void coarse_products_##suffix(const uint8_t* query, const uint8_t* row, size_t stride, \
                                                           size_t count, uint16_t* out) {                           \
    coarse_products_loop(query, row, stride, count, out);                                                           \
  }                                                                                                                 \
  __attribute__((attribute)) void evidence_##suffix(const uint16_t* products, const float* scales,                  \
                                                    const float* offsets, size_t count, const EvidenceLine& line,   \
                                                    float* out) {                                                   \
    evidence_loop(products, scales, offsets, count, line, out);                                                     \
  }                                                                                                                 \
  __attribute__((attribute)) void add_##suffix(const float* values, size_t count, float* sum) {                     \
    add_loop(values, count, sum);                                                                                   \
  }                                                                                                                 \
  constexpr Functions functions_##suffix = {dot_product_##suffix, dot_products_##suffix, coarse_products_##suffix,  \
                                            evidence_##suffix, add_##suffix};

ORTHONAV_FUNCTIONS(any, )
#if defined(__x86_64__)
ORTHONAV_FUNCTIONS(avx2, target("avx2"))
#endif

const Functions& functions() {
#if defined(__x86_64__)
  static const bool has_avx2 = __builtin_cpu_supports("avx2") != 0;
  if (has_avx2) return functions_avx2;
#endif
  return functions_any;
}

}  // namespace

int32_t dot_product(const uint8_t* a, const uint8_t* b) {
  return functions().dot_product(a, b);
}

void dot_products(const uint8_t* query, const uint8_t* descriptors, const int* which, size_t count, int32_t* out) {
  functions().dot_products(query, descriptors, which, count, out);
}

void coarse_products(const uint8_t* query, const uint8_t* row, size_t stride, size_t count, uint16_t* out) {
  functions().coarse_products(query, row, stride, count, out);
}

void evidence_of(const uint16_t* products, const float* scales, const float* offsets, size_t count,
                 const EvidenceLine& line, float* out) {
  functions().evidence(products, scales, offsets, count, line, out);
}

void add(const float* values, size_t count, float* sum) {
  functions().add(values, count, sum);
}

}  // namespace orthonav::registration
