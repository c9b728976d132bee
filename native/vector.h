// SIMD vectors, in the vector extension that GCC and Clang share: one source for SSE, AVX and NEON.
//
// Rows of nodes and of particles are handled four columns at a time; sums over a particle's nodes and decompositions
// have one particle in each lane of the widest vector. Everything is in an anonymous namespace, because files that
// include this are compiled once for each instruction set and must not share a function.

#pragma once

#include <algorithm>
#include <cstring>
#include <type_traits>
#include <utility>

#include "numbers.h"

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

// A vector of chosen lanes of another; where the number of a lane is -1 it holds anything.
template <class V, class From, int... lane>
MPMJAX_INLINE V shuffled(From from, std::integer_sequence<int, lane...>) {
#if defined(__clang__) || __GNUC__ >= 12
  return __builtin_shufflevector(from, from, lane...);
#else
  return V{from[lane < 0 ? 0 : lane]...};
#endif
}

// Lanes chosen from two vectors, those of the second counted on.
template <class V, int... lane>
MPMJAX_INLINE V shuffled(V a, V b, std::integer_sequence<int, lane...>) {
#if defined(__clang__) || __GNUC__ >= 12
  return __builtin_shufflevector(a, b, lane...);
#else
  return __builtin_shuffle(a, b, LanesOf<std::decay_t<decltype(a[0])>, sizeof...(lane)>{lane...});
#endif
}

template <int count>
using Count = std::make_integer_sequence<int, count>;

// Two vectors' lanes in turn, so many of each at a time: of their first halves, or of their second ones.
template <int together, int half, int lanes, int... lane>
constexpr auto in_turn(std::integer_sequence<int, lane...>) {
  return std::integer_sequence<int, (half * lanes / 2 + lane / (2 * together) * together + lane % together +
                                     lane / together % 2 * lanes)...>();
}
template <int together, int half, class V>
MPMJAX_INLINE V zipped(V a, V b) {
  constexpr int lanes = sizeof(V) / sizeof(a[0]);
  return shuffled(a, b, in_turn<together, half, lanes>(Count<lanes>()));
}

// Four columns of a vector's lanes as rows of four, one for each lane.
template <class V, class Rows>
MPMJAX_INLINE void to_rows(const V* columns, Rows* rows) {
  const V pairs[] = {zipped<1, 0>(columns[0], columns[1]), zipped<1, 0>(columns[2], columns[3]),
                     zipped<1, 1>(columns[0], columns[1]), zipped<1, 1>(columns[2], columns[3])};
  const V fours[] = {zipped<2, 0>(pairs[0], pairs[1]), zipped<2, 1>(pairs[0], pairs[1]),
                     zipped<2, 0>(pairs[2], pairs[3]), zipped<2, 1>(pairs[2], pairs[3])};
  std::memcpy(rows, fours, sizeof fours);
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
  uint64_t words[sizeof where / sizeof(uint64_t)], result = 0;
  std::memcpy(words, &where, sizeof where);
  for (const uint64_t word : words) result |= word;
  return result != 0;
}

// Rows of arrays (..., p) for as many particles from the k-th on as there are lanes, or until the last.
template <class T>
struct ParticleLanes {
  using V = Simd<T>;
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
