// Four numbers at once.
//
// Rows of nodes and of particles are handled four columns at a time, in the vector extension that GCC and Clang share:
// one source for SSE, AVX and NEON. Everything is in an anonymous namespace, because files that include this are
// compiled once for each instruction set and must not share a function.

#pragma once

#include <cstdint>
#include <cstring>
#include <type_traits>

#define MPMJAX_INLINE inline __attribute__((always_inline))
#define MPMJAX_INLINE_LAMBDA __attribute__((always_inline))
#define MPMJAX_NOINLINE __attribute__((noinline))  // once, not in each of its many uses

namespace {

constexpr int kLanes = 4;

constexpr int power(int base, int exponent) { return exponent == 0 ? 1 : base * power(base, exponent - 1); }

#if defined(__AVX512F__)
constexpr int kWidest = 64;  // bytes of the widest vector
#elif defined(__AVX__)
constexpr int kWidest = 32;
#else
constexpr int kWidest = 16;
#endif

template <class T>
struct VectorOf {
  typedef T type __attribute__((vector_size(kLanes * sizeof(T))));
};

template <class T>
using Vector = typename VectorOf<T>::type;

// A vector at any address.
template <class T>
MPMJAX_INLINE Vector<T> load(const T* from) {
  Vector<T> v;
  std::memcpy(&v, from, sizeof v);
  return v;
}

template <class T>
MPMJAX_INLINE void store(T* to, Vector<T> v) {
  std::memcpy(to, &v, sizeof v);
}

// As many integers as wide as the numbers: choices of lanes and masks of their bits.
template <class T, int lanes>
struct LanesOf;
template <int lanes>
struct LanesOf<float, lanes> {
  typedef int32_t type __attribute__((vector_size(lanes * sizeof(int32_t))));
};
template <int lanes>
struct LanesOf<double, lanes> {
  typedef int64_t type __attribute__((vector_size(lanes * sizeof(int64_t))));
};
template <class T>
using Lanes = typename LanesOf<T, kLanes>::type;

#if defined(__clang__)
#define MPMJAX_SHUFFLE(a, b, i, j, k, l) __builtin_shufflevector(a, b, i, j, k, l)
#else
#define MPMJAX_SHUFFLE(a, b, i, j, k, l) __builtin_shuffle(a, b, Lanes<T>{i, j, k, l})
#endif

// The transpose of four vectors.
template <class T>
MPMJAX_INLINE void transpose(const Vector<T>* from, Vector<T>* to) {
  const Vector<T> a = MPMJAX_SHUFFLE(from[0], from[1], 0, 4, 1, 5), b = MPMJAX_SHUFFLE(from[0], from[1], 2, 6, 3, 7);
  const Vector<T> c = MPMJAX_SHUFFLE(from[2], from[3], 0, 4, 1, 5), d = MPMJAX_SHUFFLE(from[2], from[3], 2, 6, 3, 7);
  to[0] = MPMJAX_SHUFFLE(a, c, 0, 1, 4, 5);
  to[1] = MPMJAX_SHUFFLE(a, c, 2, 3, 6, 7);
  to[2] = MPMJAX_SHUFFLE(b, d, 0, 1, 4, 5);
  to[3] = MPMJAX_SHUFFLE(b, d, 2, 3, 6, 7);
}

// Calls f(0), ..., f(count - 1): written out with constants, or as a loop where speed matters less than the size of the
// code.
template <int count, bool written_out, class F>
MPMJAX_INLINE void each(const F& f) {
  if constexpr (written_out) {
    static_assert(count <= 4, "as many nodes as the cubic kernel has");
    f(std::integral_constant<int, 0>());
    if constexpr (count > 1) f(std::integral_constant<int, 1>());
    if constexpr (count > 2) f(std::integral_constant<int, 2>());
    if constexpr (count > 3) f(std::integral_constant<int, 3>());
  } else {
#if defined(__clang__)
#pragma clang loop unroll(disable) vectorize(disable)
#else
#pragma GCC unroll 1
#endif
    for (int i = 0; i < count; ++i) f(i);
  }
}

}  // namespace
