// The loops of OrientationField in which its time is spent, for whichever instruction set the machine has; all give the
// same bits. Nodes are kChannels floats each.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

#include "common/features/fixed_sift.h"

namespace orthonav {

inline constexpr int kChannels = 8;
inline constexpr int kCells = 4;
static_assert(kCells * kCells * kChannels == kSiftBytes);

// Central differences of a line and those above and below it, times `gain`, but for its first and last pixel.
void differentiate(const float* above, const float* line, const float* below, int count, float gain, float* x,
                   float* y);

// Adds gradients of a line, `count` magnitudes and directions (rad, in [0, 2 pi]), to nodes of `block` pixels each: of
// every gradient its share of the two nearest channels, `turn` channels (in [0, kChannels)) on.
void add_gradients(const float* magnitudes, const float* directions, int count, int block, float turn, float* nodes);

// out[i] = sum over k of window[k] in[k][i], for `count` floats, a multiple of kChannels.
void weigh(const float* window, const float* const* in, size_t taps, size_t count, float* out);

// Nodes of a field, columns x rows of them, `stride` floats from row to row.
struct NodeField {
  const float* nodes;
  ptrdiff_t stride;
  int columns, rows;
};

// Where a descriptor's cells lie in a field, nodes: the first, and from one to the next to the right and downwards.
struct CellPlaces {
  std::array<float, 2> first, right, down;
};

struct RootSiftLimits {
  float least;    // sum of all histograms below which there is no texture
  float largest;  // a channel's share of their length, to which it is limited
  float length;   // of the descriptor
};

// RootSIFT in bytes of the cells' histograms, interpolated between nodes, zero outside, times the cells' weights:
// square roots of shares of the squared length. False and zeros without texture.
bool describe_cells(const NodeField& field, const CellPlaces& places, const float* weights,
                    const RootSiftLimits& limits, uint8_t* out);

}  // namespace orthonav
