// Particles abreast: a number of each in the lanes of the widest vector, and 3 x 3 matrices of such numbers.

#pragma once

#include <algorithm>
#include <cmath>

#include "vector.h"

namespace {

template <class T>
struct SimdOf {
  typedef T type __attribute__((vector_size(kWidest)));
};

template <class T>
using Simd = typename SimdOf<T>::type;

// How many they are.
template <class T>
constexpr int64_t kSimdLanes = kWidest / static_cast<int>(sizeof(T));

template <class V>
MPMJAX_INLINE V magnitude(V x) {
  return x < 0 ? -x : x;
}

template <class V>
MPMJAX_INLINE V root(V x) {
#if defined(__clang__)
  return __builtin_elementwise_sqrt(x);
#else
  V y = {};
#pragma GCC unroll 16
  for (size_t i = 0; i < sizeof x / sizeof x[0]; ++i) y[i] = std::sqrt(x[i]);
  return y;
#endif
}

// Whether a comparison holds in any lane.
template <class M>
MPMJAX_INLINE bool any(M where) {
  M none = {};
  return std::memcmp(&where, &none, sizeof where) != 0;
}

template <class V>
struct Matrix {
  V at[3][3];
};

// Calls f(i, j) for all components.
template <class F>
MPMJAX_INLINE void components(const F& f) {
  each<3, true>([&](auto i) MPMJAX_INLINE_LAMBDA { each<3, true>([&](auto j) MPMJAX_INLINE_LAMBDA { f(i, j); }); });
}

// Calls f(i, j) for those of the upper triangle.
template <class F>
MPMJAX_INLINE void upper_components(const F& f) {
  components([&](auto i, auto j) MPMJAX_INLINE_LAMBDA {
    if constexpr (j >= i) f(i, j);
  });
}

// Where some particles' numbers are in arrays (..., p): as many from the first on as there are until the last.
template <class T>
struct Place {
  int64_t first, stride;
  size_t bytes;

  Place(int64_t k, int64_t last, int64_t particles)
      : first(k), stride(particles), bytes(sizeof(T) * static_cast<size_t>(std::min(kSimdLanes<T>, last - k))) {}

  // Row m of an array. Lanes of no particle are zero.
  MPMJAX_INLINE Simd<T> load(const T* array, int64_t m) const {
    Simd<T> v = {};
    if (bytes == sizeof v) {
      std::memcpy(&v, array + m * stride + first, sizeof v);
    } else {
      std::memcpy(&v, array + m * stride + first, bytes);
    }
    return v;
  }

  MPMJAX_INLINE void store(T* array, int64_t m, Simd<T> v) const {
    if (bytes == sizeof v) {
      std::memcpy(array + m * stride + first, &v, sizeof v);
    } else {
      std::memcpy(array + m * stride + first, &v, bytes);
    }
  }
};

}  // namespace
