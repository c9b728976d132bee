// SIMD vectors, in the vector extension that GCC and Clang share: one source for SSE, AVX and NEON.
//
// Rows of nodes and of particles are handled four columns at a time; sums over a particle's nodes and decompositions
// have one particle in each lane of the widest vector. Everything is in an anonymous namespace, because files that
// include this are compiled once for each instruction set and must not share a function.

#pragma once

#include <algorithm>
#include <cmath>
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

// Lanes of the widest vector. Particles' nodes are read by fours, so two registers make one vector where one holds
// less.
template <class T>
constexpr int kSimdLanes = std::max<int>(kLanes, kWidest / sizeof(T));

template <class T, int lanes>
struct VectorOf {
  typedef T type __attribute__((vector_size(lanes * sizeof(T))));
};

template <class T>
using Vector = typename VectorOf<T, kLanes>::type;
template <class T>
using Simd = typename VectorOf<T, kSimdLanes<T>>::type;

// As many integers as wide as the numbers: choices of lanes and masks of their bits.
template <class T, int lanes>
using LanesOf = typename VectorOf<std::conditional_t<sizeof(T) == 4, int32_t, int64_t>, lanes>::type;

// A vector at any address.
template <class V, class T>
MPMJAX_INLINE V load_as(const T* from) {
  V v;
  std::memcpy(&v, from, sizeof v);
  return v;
}

template <class T, class V>
MPMJAX_INLINE void store(T* to, V v) {
  std::memcpy(to, &v, sizeof v);
}

#if defined(__clang__)
#define MPMJAX_SHUFFLE(a, b, i, j, k, l) __builtin_shufflevector(a, b, i, j, k, l)
#else
#define MPMJAX_SHUFFLE(a, b, i, j, k, l) __builtin_shuffle(a, b, LanesOf<T, kLanes>{i, j, k, l})
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

// Calls f(0), ..., f(count - 1): unrolled with constants, or as a loop where speed matters less than the size of the
// code.
template <int count, bool unrolled = true, class F>
MPMJAX_INLINE void each(const F& f) {
  if constexpr (unrolled) {
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

// Whether a comparison holds in any lane.
template <class M>
MPMJAX_INLINE bool any(M where) {
  uint64_t words[sizeof where / sizeof(uint64_t)], result = 0;
  std::memcpy(words, &where, sizeof where);
  for (const uint64_t word : words) result |= word;
  return result != 0;
}

// Rows of arrays (..., p) for as many particles from the k-th on as there are lanes, or until the last.
template <class T>
struct ParticleLanes {
  int64_t first, stride;
  size_t bytes;

  ParticleLanes(int64_t k, int64_t last, int64_t particles)
      : first(k), stride(particles), bytes(sizeof(T) * std::min<int64_t>(kSimdLanes<T>, last - k)) {}

  MPMJAX_INLINE bool whole() const { return bytes == sizeof(Simd<T>); }

  // Row m, with `all` of every lane. Lanes of no particle are zero.
  template <bool all = false>
  MPMJAX_INLINE Simd<T> load(const T* array, int64_t m) const {
    Simd<T> v = {};
    std::memcpy(&v, array + m * stride + first, all ? sizeof v : bytes);
    return v;
  }

  template <bool all = false>
  MPMJAX_INLINE void store(T* array, int64_t m, Simd<T> v) const {
    std::memcpy(array + m * stride + first, &v, all ? sizeof v : bytes);
  }
};

// Calls f(whether all lanes are used), a constant: copies of any size are calls, around which nothing stays in
// registers.
template <class T, class F>
MPMJAX_INLINE void by_lanes(const ParticleLanes<T>& lanes, const F& f) {
  lanes.whole() ? f(std::true_type()) : f(std::false_type());
}

}  // namespace
