#include "common/features/orientation_kernels.h"

#include <algorithm>
#include <cmath>

#include "common/math/instruction_sets.h"

namespace orthonav {
namespace {

static_assert(kChannels * sizeof(float) == sizeof(Floats));
using Node = Floats;

// Row k is 1 in channel k: what goes into two channels is added to all at once, without a jump by which they are.
constexpr auto kUnits = [] {
  std::array<float, kChannels * kChannels> units{};
  for (size_t k = 0; k < kChannels; ++k) units[k * kChannels + k] = 1;
  return units;
}();

ORTHONAV_INLINE void differentiate_loop(const float* above, const float* line, const float* below, int count,
                                        float gain, float* x, float* y) {
  for (int u = 1; u + 1 < count; ++u) {
    x[u] = gain * (line[u + 1] - line[u - 1]);
    y[u] = gain * (below[u] - above[u]);
  }
}

ORTHONAV_INLINE void add_gradients_loop(const float* magnitudes, const float* directions, int count, int block,
                                        float turn, float* nodes) {
  constexpr float kPerRadian = static_cast<float>(kChannels / (2 * M_PI));
  for (int first = 0; first < count; first += block, nodes += kChannels) {
    Node sum, lower_unit, upper_unit;
    load(nodes, sum);
    const int end = std::min(count, first + block);
    for (int u = first; u < end; ++u) {
      const float bin = directions[u] * kPerRadian + turn;
      const int lower = static_cast<int>(bin);
      const float upper_share = (bin - static_cast<float>(lower)) * magnitudes[u];
      load(&kUnits[static_cast<size_t>(kChannels * (lower & (kChannels - 1)))], lower_unit);
      load(&kUnits[static_cast<size_t>(kChannels * ((lower + 1) & (kChannels - 1)))], upper_unit);
      sum += (magnitudes[u] - upper_share) * lower_unit + upper_share * upper_unit;
    }
    store(sum, nodes);
  }
}

template <size_t nodes>
ORTHONAV_INLINE void weigh_nodes(const float* window, const float* const* in, size_t taps, size_t first, float* out) {
  Node sums[nodes] = {};  // NOLINT: stay in registers
  for (size_t k = 0; k < taps; ++k) {
    for (size_t i = 0; i < nodes; ++i) {
      Node node;
      load(in[k] + first + kChannels * i, node);
      sums[i] += window[k] * node;
    }
  }
  for (size_t i = 0; i < nodes; ++i) store(sums[i], out + first + kChannels * i);
}

ORTHONAV_INLINE void weigh_loop(const float* window, const float* const* in, size_t taps, size_t count, float* out) {
  constexpr size_t kAtOnce = 4;
  size_t i = 0;
  for (; i + kAtOnce * kChannels <= count; i += kAtOnce * kChannels) weigh_nodes<kAtOnce>(window, in, taps, i, out);
  for (; i < count; i += kChannels) weigh_nodes<1>(window, in, taps, i, out);
}

// Of a number above -2^31; std::floor is a call where the machine may be an old one.
ORTHONAV_INLINE int round_down(float value) {
  const int towards_zero = static_cast<int>(value);
  return towards_zero - (static_cast<float>(towards_zero) > value ? 1 : 0);
}

ORTHONAV_INLINE void sample_cells(const NodeField& field, const CellPlaces& places, const float* weights,
                                  float* histograms) {
  for (int cell = 0; cell < kCells * kCells; ++cell, histograms += kChannels) {
    const int row = cell / kCells, column = cell % kCells;
    const auto right = static_cast<float>(column), down = static_cast<float>(row);
    const float x = places.first[0] + right * places.right[0] + down * places.down[0];
    const float y = places.first[1] + right * places.right[1] + down * places.down[1];
    Node sum = {};
    // The outermost nodes are the field's border of zeros.
    if (x > -1 && y > -1 && x < static_cast<float>(field.columns - 2) && y < static_cast<float>(field.rows - 2)) {
      const int u = round_down(x), v = round_down(y);
      const float a = x - static_cast<float>(u), b = y - static_cast<float>(v);
      const float weight = weights[cell];
      const float* node = field.nodes + (v + 1) * field.stride + kChannels * (u + 1);
      Node upper_left, upper_right, lower_left, lower_right;
      load(node, upper_left);
      load(node + kChannels, upper_right);
      load(node + field.stride, lower_left);
      load(node + field.stride + kChannels, lower_right);
      sum = weight * (1 - a) * (1 - b) * upper_left + weight * a * (1 - b) * upper_right +
            weight * (1 - a) * b * lower_left + weight * a * b * lower_right;
    }
    store(sum, histograms);
  }
}

ORTHONAV_INLINE bool root_sift(float* histograms, const RootSiftLimits& limits, uint8_t* out) {
  Node sum = {}, squares = {}, node;
  for (int i = 0; i < kSiftBytes; i += kChannels) {
    load(histograms + i, node);
    sum += node;
    squares += node * node;
  }
  if (!(sum_of(sum) > limits.least)) {
    std::fill_n(out, kSiftBytes, uint8_t{0});
    return false;
  }
  const float limit = limits.largest * std::sqrt(sum_of(squares));
  sum = Node{};
  for (int i = 0; i < kSiftBytes; ++i) histograms[i] = histograms[i] < limit ? histograms[i] : limit;
  for (int i = 0; i < kSiftBytes; i += kChannels) {
    load(histograms + i, node);
    sum += node;
  }
  const float scale = limits.length * limits.length / sum_of(sum);
  for (int i = 0; i < kSiftBytes; ++i) {
    const float root = std::sqrt(scale * histograms[i]) + 0.5F;
    out[i] = static_cast<uint8_t>(static_cast<int>(root < 255.0F ? root : 255.0F));
  }
  return true;
}

ORTHONAV_INLINE bool describe_cells_loop(const NodeField& field, const CellPlaces& places, const float* weights,
                                         const RootSiftLimits& limits, uint8_t* out) {
  alignas(32) float histograms[kSiftBytes];  // NOLINT: filled by the next line
  sample_cells(field, places, weights, histograms);
  return root_sift(histograms, limits, out);
}

struct Functions {
  decltype(&orthonav::differentiate) differentiate;
  decltype(&orthonav::add_gradients) add_gradients;
  decltype(&orthonav::weigh) weigh;
  decltype(&orthonav::describe_cells) describe_cells;
};

// One set of functions for an instruction set; `attribute` is the one that asks for it.
#define ORTHONAV_FUNCTIONS(suffix, attribute)                                                                         \
  __attribute__((attribute)) void differentiate_##suffix(const float* above, const float* line, const float* below,   \
                                                         int count, float gain, float* x, float* y) {                 \
    differentiate_loop(above, line, below, count, gain, x, y);                                                        \
  }                                                                                                                   \
  __attribute__((attribute)) void add_gradients_##suffix(const float* magnitudes, const float* directions, int count, \
                                                         int block, float turn, float* nodes) {                       \
    add_gradients_loop(magnitudes, directions, count, block, turn, nodes);                                            \
  }                                                                                                                   \
  __attribute__((attribute)) void weigh_##suffix(const float* window, const float* const* in, size_t taps,            \
                                                 size_t count, float* out) {                                          \
    weigh_loop(window, in, taps, count, out);                                                                         \
  }                                                                                                                   \
  __attribute__((attribute)) bool describe_cells_##suffix(const NodeField& field, const CellPlaces& places,           \
                                                          const float* weights, const RootSiftLimits& limits,         \
                                                          uint8_t* out) {                                             \
    return describe_cells_loop(field, places, weights, limits, out);                                                  \
  }                                                                                                                   \
  constexpr Functions functions_##suffix = {differentiate_##suffix, add_gradients_##suffix, weigh_##suffix,           \
                                            describe_cells_##suffix};

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

void differentiate(const float* above, const float* line, const float* below, int count, float gain, float* x,
                   float* y) {
  functions().differentiate(above, line, below, count, gain, x, y);
}

void add_gradients(const float* magnitudes, const float* directions, int count, int block, float turn, float* nodes) {
  functions().add_gradients(magnitudes, directions, count, block, turn, nodes);
}

void weigh(const float* window, const float* const* in, size_t taps, size_t count, float* out) {
  functions().weigh(window, in, taps, count, out);
}

bool describe_cells(const NodeField& field, const CellPlaces& places, const float* weights,
                    const RootSiftLimits& limits, uint8_t* out) {
  return functions().describe_cells(field, places, weights, limits, out);
}

}  // namespace orthonav
