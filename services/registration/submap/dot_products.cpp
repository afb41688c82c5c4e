#include "services/registration/submap/dot_products.h"

#include <array>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

#include "common/features/fixed_sift.h"
#include "common/math/instruction_sets.h"

namespace orthonav::registration {
namespace {

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

void coarse_products_any(const uint8_t* query, const uint8_t* row, size_t stride, size_t count, uint16_t* out) {
  // Blocks that stay in registers while the pairs pass.
  constexpr size_t kBlock = 64;
  for (size_t first = 0; first < count; first += kBlock) {
    const size_t size = std::min(kBlock, count - first);
    uint16_t sums[kBlock] = {};  // NOLINT: a plain array is what the compiler keeps in registers
    for (size_t k = 0; k < kCoarseBytes; k += 2) {
      const uint8_t* pairs = row + k * stride + 2 * first;
      const uint16_t factors[2] = {query[k], query[k + 1]};  // NOLINT: as above
      for (size_t i = 0; i < size; ++i) {
        sums[i] = static_cast<uint16_t>(sums[i] + factors[0] * pairs[2 * i] + factors[1] * pairs[2 * i + 1]);
      }
    }
    std::copy_n(sums, size, out + first);
  }
}

void add_bytes_any(const uint8_t* values, size_t count, uint16_t* sum) {
  for (size_t i = 0; i < count; ++i) sum[i] = static_cast<uint16_t>(sum[i] + values[i]);
}

#if defined(__x86_64__)
// Compilers do not find the instruction that multiplies bytes and adds them in pairs.
__attribute__((target("avx2"))) void coarse_products_avx2(const uint8_t* query, const uint8_t* row, size_t stride,
                                                          size_t count, uint16_t* out) {
  constexpr size_t kLanes = 16, kBlock = 4 * kLanes;  // four sums stay in registers while the pairs pass
  if (count < kBlock) return coarse_products_any(query, row, stride, count, out);
  for (size_t next = 0; next < count; next += kBlock) {
    const size_t first = std::min(next, count - kBlock);  // the last block overlaps the one before it
    __m256i sums[4] = {_mm256_setzero_si256(), _mm256_setzero_si256(), _mm256_setzero_si256(),  // NOLINT: registers
                       _mm256_setzero_si256()};
    for (size_t k = 0; k < kCoarseBytes; k += 2) {
      const __m256i factors = _mm256_set1_epi16(static_cast<int16_t>(query[k] | query[k + 1] << 8));
      const uint8_t* pairs = row + k * stride + 2 * first;
      for (size_t i = 0; i < 4; ++i) {
        const __m256i values = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(pairs + 2 * kLanes * i));
        sums[i] = _mm256_add_epi16(sums[i], _mm256_maddubs_epi16(values, factors));
      }
    }
    for (size_t i = 0; i < 4; ++i) {
      _mm256_storeu_si256(reinterpret_cast<__m256i*>(out + first + kLanes * i), sums[i]);
    }
  }
}

// Rows are short: what compilers do one by one at their ends takes half of the time.
__attribute__((target("avx2"))) void add_bytes_avx2(const uint8_t* values, size_t count, uint16_t* sum) {
  constexpr size_t kLanes = 16;
  if (count < kLanes) return add_bytes_any(values, count, sum);
  const auto add_to = [](__m128i bytes, uint16_t * out) __attribute__((target("avx2"))) {
    auto* at = reinterpret_cast<__m256i*>(out);
    _mm256_storeu_si256(at, _mm256_add_epi16(_mm256_loadu_si256(at), _mm256_cvtepu8_epi16(bytes)));
  };
  const auto load = [](const uint8_t* from) { return _mm_loadu_si128(reinterpret_cast<const __m128i*>(from)); };
  size_t i = 0;
  for (; i + kLanes <= count; i += kLanes) add_to(load(values + i), sum + i);
  if (i == count) return;
  // The last lanes again, without what is added already.
  alignas(32) static constexpr std::array<uint8_t, 2 * kLanes> kMask = [] {
    std::array<uint8_t, 2 * kLanes> mask{};
    std::fill(mask.begin() + kLanes, mask.end(), uint8_t{255});
    return mask;
  }();
  const size_t last = count - kLanes;
  add_to(_mm_and_si128(load(values + last), load(&kMask[kLanes - (i - last)])), sum + last);
}
#endif

ORTHONAV_INLINE void evidence_loop(const uint16_t* products, const float* scales, const float* offsets, size_t count,
                                   const EvidenceLine& line, float levels, uint8_t* out) {
  const EvidenceLine l = line;
  for (size_t i = 0; i < count; ++i) {
    const float value = levels * l.evidence(products[i], scales[i], offsets[i]);
    out[i] = static_cast<uint8_t>(static_cast<int32_t>(value + 0.5F));  // NOLINT: never negative; lround is a call
  }
}

ORTHONAV_INLINE void evidence_at_loop(const int32_t* products, const int* which, const MapIndex::Centring* centring,
                                      size_t count, const EvidenceLine& line, float* out) {
  const EvidenceLine l = line;
  for (size_t i = 0; i < count; ++i) {
    const MapIndex::Centring& c = centring[std::max(which[i], 0)];
    const float value = l.evidence(static_cast<float>(products[i]), c.scale, c.offset);
    out[i] = which[i] < 0 ? 0.0F : value;
  }
}

template <class Value>
ORTHONAV_INLINE void largest_loop(const Value* a, const Value* b, const Value* c, size_t count, Value* out) {
  for (size_t i = 0; i < count; ++i) {
    const Value ab = a[i] > b[i] ? a[i] : b[i];
    out[i] = ab > c[i] ? ab : c[i];
  }
}

ORTHONAV_INLINE void add_loop(const float* values, size_t count, float* sum) {
  for (size_t i = 0; i < count; ++i) sum[i] += values[i];
}
ORTHONAV_INLINE void add_words_loop(const uint16_t* values, float unit, size_t count, float* sum) {
  for (size_t i = 0; i < count; ++i) sum[i] += unit * static_cast<float>(values[i]);
}

ORTHONAV_INLINE float quadratic_form_loop(const float* vector, const float* matrix, size_t size) {
  constexpr size_t kEach = 8, kAtOnce = 4;  // columns
  Floats total = {}, values;
  for (size_t first = 0; first < size; first += kEach * kAtOnce) {
    Floats sums[kAtOnce] = {};  // NOLINT: as above
    // Of the blocks beside the diagonal those below it, twice.
    for (size_t row = first; row < size; ++row) {
      const float factor = row < first + kEach * kAtOnce ? vector[row] : 2 * vector[row];
      for (size_t i = 0; i < kAtOnce; ++i) {
        load(matrix + row * size + first + kEach * i, values);
        sums[i] += factor * values;
      }
    }
    for (size_t i = 0; i < kAtOnce; ++i) {
      load(vector + first + kEach * i, values);
      total += sums[i] * values;
    }
  }
  return sum_of(total);
}

struct Functions {
  decltype(&coarse_products_any) coarse_products;
  decltype(&add_bytes_any) add_bytes;
  int32_t (*dot_product)(const uint8_t*, const uint8_t*);
  void (*dot_products)(const uint8_t*, const uint8_t*, const int*, size_t, int32_t*);
  void (*evidence)(const uint16_t*, const float*, const float*, size_t, const EvidenceLine&, float, uint8_t*);
  void (*evidence_at)(const int32_t*, const int*, const MapIndex::Centring*, size_t, const EvidenceLine&, float*);
  void (*largest)(const float*, const float*, const float*, size_t, float*);
  void (*largest_words)(const uint16_t*, const uint16_t*, const uint16_t*, size_t, uint16_t*);
  void (*add)(const float*, size_t, float*);
  void (*add_words)(const uint16_t*, float, size_t, float*);
  float (*quadratic_form)(const float*, const float*, size_t);
};

// One set of functions for an instruction set; `attribute` is the one that asks for it.
#define ORTHONAV_FUNCTIONS(suffix, attribute)                                                                        \
  __attribute__((attribute)) int32_t dot_product_##suffix(const uint8_t* a, const uint8_t* b) {                      \
    return dot_product_loop(a, b);                                                                                   \
  }                                                                                                                  \
  __attribute__((attribute)) void dot_products_##suffix(const uint8_t* query, const uint8_t* descriptors,            \
                                                        const int* which, size_t count, int32_t* out) {              \
    dot_products_loop(query, descriptors, which, count, out);                                                        \
  }                                                                                                                  \
  __attribute__((attribute)) void evidence_##suffix(const uint16_t* products, const float* scales,                   \
                                                    const float* offsets, size_t count, const EvidenceLine& line,    \
                                                    float levels, uint8_t* out) {                                    \
    evidence_loop(products, scales, offsets, count, line, levels, out);                                              \
  }                                                                                                                  \
  __attribute__((attribute)) void evidence_at_##suffix(const int32_t* products, const int* which,                    \
                                                       const MapIndex::Centring* centring, size_t count,             \
                                                       const EvidenceLine& line, float* out) {                       \
    evidence_at_loop(products, which, centring, count, line, out);                                                   \
  }                                                                                                                  \
  __attribute__((attribute)) void largest_##suffix(const float* a, const float* b, const float* c, size_t count,     \
                                                   float* out) {                                                     \
    largest_loop(a, b, c, count, out);                                                                               \
  }                                                                                                                  \
  __attribute__((attribute)) void largest_words_##suffix(const uint16_t* a, const uint16_t* b, const uint16_t* c,    \
                                                         size_t count, uint16_t* out) {                              \
    largest_loop(a, b, c, count, out);                                                                               \
  }                                                                                                                  \
  __attribute__((attribute)) void add_##suffix(const float* values, size_t count, float* sum) {                      \
    add_loop(values, count, sum);                                                                                    \
  }                                                                                                                  \
  __attribute__((attribute)) void add_words_##suffix(const uint16_t* values, float unit, size_t count, float* sum) { \
    add_words_loop(values, unit, count, sum);                                                                        \
  }                                                                                                                  \
  __attribute__((attribute)) float quadratic_form_##suffix(const float* vector, const float* matrix, size_t size) {  \
    return quadratic_form_loop(vector, matrix, size);                                                                \
  }                                                                                                                  \
  constexpr Functions functions_##suffix = {coarse_products_##suffix, add_bytes_##suffix,     dot_product_##suffix,  \
                                            dot_products_##suffix,    evidence_##suffix,      evidence_at_##suffix,  \
                                            largest_##suffix,         largest_words_##suffix, add_##suffix,          \
                                            add_words_##suffix,       quadratic_form_##suffix};

ORTHONAV_FUNCTIONS(any, )
#if defined(__x86_64__)
ORTHONAV_FUNCTIONS(avx2, target("avx2"))
#endif

const Functions& functions() {
#if defined(__x86_64__)
  if (has_avx2()) return functions_avx2;
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
                 const EvidenceLine& line, float levels, uint8_t* out) {
  functions().evidence(products, scales, offsets, count, line, levels, out);
}

void evidence_of(const int32_t* products, const int* which, const MapIndex::Centring* centring, size_t count,
                 const EvidenceLine& line, float* out) {
  functions().evidence_at(products, which, centring, count, line, out);
}

void largest_of(const float* a, const float* b, const float* c, size_t count, float* out) {
  functions().largest(a, b, c, count, out);
}

void largest_of(const uint16_t* a, const uint16_t* b, const uint16_t* c, size_t count, uint16_t* out) {
  functions().largest_words(a, b, c, count, out);
}

void add(const float* values, size_t count, float* sum) {
  functions().add(values, count, sum);
}

void add(const uint8_t* values, size_t count, uint16_t* sum) {
  functions().add_bytes(values, count, sum);
}

void add(const uint16_t* values, float unit, size_t count, float* sum) {
  functions().add_words(values, unit, count, sum);
}

float quadratic_form(const float* vector, const float* matrix, size_t size) {
  return functions().quadratic_form(vector, matrix, size);
}

}  // namespace orthonav::registration
