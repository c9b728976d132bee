// Code for one particle, or for one in each lane of a vector: V is a number, or a vector of numbers. CUDA reads it too.

#pragma once

#include "problems.h"

#if defined(__CUDACC_RTC__)
#define MPMJAX_INLINE __forceinline__
#define MPMJAX_INLINE_LAMBDA
#define MPMJAX_UNROLL _Pragma("unroll")
#else
#include <cmath>
#define MPMJAX_INLINE inline __attribute__((always_inline))
#define MPMJAX_INLINE_LAMBDA __attribute__((always_inline))
#define MPMJAX_UNROLL
#endif

namespace {

template <int i>
struct Constant {
  static constexpr int value = i;
  constexpr operator int() const { return i; }
};

// Calls f(0), ..., f(count - 1): unrolled with constants, or as a loop where speed matters less than the size of the
// code.
template <int count, bool unrolled = true, class F>
MPMJAX_INLINE void each(const F& f) {
  if constexpr (unrolled) {
    static_assert(count <= 4, "as many nodes as the cubic kernel has");
    f(Constant<0>());
    if constexpr (count > 1) f(Constant<1>());
    if constexpr (count > 2) f(Constant<2>());
    if constexpr (count > 3) f(Constant<3>());
  } else {
#if defined(__clang__)
#pragma clang loop unroll(disable) vectorize(disable)
#elif !defined(__CUDACC_RTC__)
#pragma GCC unroll 1
#endif
    for (int i = 0; i < count; ++i) f(i);
  }
}

MPMJAX_INLINE float root(float x) { return sqrtf(x); }
MPMJAX_INLINE double root(double x) { return sqrt(x); }
MPMJAX_INLINE bool any(bool where) { return where; }
MPMJAX_INLINE bool any(int where) { return where != 0; }

}  // namespace
