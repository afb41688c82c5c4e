// Loops compiled for several instruction sets, the best of which is chosen at run time: the build is for any machine
// of its kind, and half of the time is spent in a few loops.
//
// Write a loop as an ORTHONAV_INLINE function, and for each set a function with the attribute that asks for it which
// calls it. What is computed may not depend on the vectors' width: integers, or floats in the same order, without fused
// multiplications. Then all give the same bits.
#pragma once

#include <cstring>

#define ORTHONAV_INLINE inline __attribute__((always_inline))

namespace orthonav {

// Eight floats in a register, or in two where they are shorter: of a plain array that is summed up in a loop compilers
// tend to keep no part in registers, and each addition waits for the store before it.
using Floats = float __attribute__((vector_size(32)));  // NOLINT

ORTHONAV_INLINE void load(const float* from, Floats& to) {
  std::memcpy(&to, from, sizeof(to));
}
ORTHONAV_INLINE void store(const Floats& from, float* to) {
  std::memcpy(to, &from, sizeof(from));
}
ORTHONAV_INLINE float sum_of(const Floats& of) {
  return ((of[0] + of[1]) + (of[2] + of[3])) + ((of[4] + of[5]) + (of[6] + of[7]));
}

#if defined(__x86_64__)
// Whether what is compiled with target("avx2") runs here.
inline bool has_avx2() {
  static const bool has = __builtin_cpu_supports("avx2") != 0;
  return has;
}
#endif

}  // namespace orthonav
