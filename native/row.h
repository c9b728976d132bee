// Rows: what the nodes of a stencil along the last axis have, some columns at each.
//
// These nodes follow each other in memory, so that several make one vector. A sum over a stencil's nodes is then one
// over its rows, and only at one end of it over the nodes of a row.

#pragma once

#include "vector.h"
#if defined(__AVX2__)
#include <immintrin.h>
#endif

namespace {

constexpr int power_of_two(int least) { return least <= 1 ? 1 : 2 * power_of_two((least + 1) / 2); }

// How many nodes, at most so many, fit into one vector.
template <class T>
constexpr int fitting(int most, int columns) {
  const bool fits = power_of_two(most * columns) * static_cast<int>(sizeof(T)) <= kWidest;
  return fits || most == 1 ? most : fitting<T>(most - 1, columns);
}

// Numbers of s nodes in parts, each a vector with some nodes together. Lanes that belong to no node hold anything.
template <class T, int s_, int columns_, int together_>
struct Row {
  static constexpr int s = s_, columns = columns_, together = together_;
  static constexpr int count = (s + together - 1) / together;
  static constexpr int lanes = power_of_two(together * columns);

  using Part = typename VectorOf<T, lanes>::type;
  using Mask = LanesOf<T, lanes>;
  // Four numbers, and as many others as a part has.
  using Four = typename VectorOf<T, (lanes > kLanes ? lanes : kLanes)>::type;
  Part parts[count];

  // The node that a lane of a part belongs to, or -1.
  static constexpr int node(int part, int lane) {
    const int result = part * together + lane / columns;
    return lane < together * columns && result < s ? result : -1;
  }

  // Where the columns of a node are among the lanes of all parts.
  static constexpr int place(int i) { return i / together * lanes + i % together * columns; }

  // How many numbers the parts reach over, where each node has so many.
  static constexpr int64_t reach(int64_t stride) { return (count - 1) * together * stride + lanes; }

  template <class F>
  static MPMJAX_INLINE Row of(const F& part) {
    Row row;
    each<count>([&](auto k) MPMJAX_INLINE_LAMBDA { row.parts[k] = part(k); });
    return row;
  }
  friend MPMJAX_INLINE Row operator*(T a, const Row& x) {
    return of([&](int k) MPMJAX_INLINE_LAMBDA { return a * x.parts[k]; });
  }
  friend MPMJAX_INLINE Row operator*(const Row& a, const Row& x) {
    return of([&](int k) MPMJAX_INLINE_LAMBDA { return a.parts[k] * x.parts[k]; });
  }
  friend MPMJAX_INLINE Row operator+(const Row& a, const Row& b) {
    return of([&](int k) MPMJAX_INLINE_LAMBDA { return a.parts[k] + b.parts[k]; });
  }
};

// All columns of the nodes, or where their number is 0 when this is compiled, four of any number.
template <class T, int s, int columns>
using RowOf = Row<T, s, columns == 0 ? kLanes : columns, columns == 0 ? 1 : fitting<T>(s, columns)>;

// For the lanes of a part, their nodes and their columns.
template <class R, int part, int... lane>
constexpr auto nodes_of(std::integer_sequence<int, lane...>) {
  return std::integer_sequence<int, R::node(part, lane)...>();
}
template <class R, int... lane>
constexpr auto columns_of(std::integer_sequence<int, lane...>) {
  return std::integer_sequence<int, (lane < R::together * R::columns ? lane % R::columns : -1)...>();
}

// Four numbers as the first of a wider vector. They were stored as four, and a processor waits for the stores where more
// is read than one of them wrote.
template <class Wide, class Four>
MPMJAX_INLINE Wide widened(const Four& four) {
#if defined(__AVX512F__)
  if constexpr (sizeof(Wide) == 64 && sizeof(four[0]) == 4) return (Wide)_mm512_castps128_ps512((__m128)four);
  if constexpr (sizeof(Wide) == 64 && sizeof(four[0]) == 8) return (Wide)_mm512_castpd256_pd512((__m256d)four);
#endif
#if defined(__AVX2__)
  if constexpr (sizeof(Wide) == 32 && sizeof(four[0]) == 4) return (Wide)_mm256_castps128_ps256((__m128)four);
#endif
  return load_as<Wide>(&four);
}

// A row that has at each node its own of four numbers, in all columns.
template <class R, class Four>
MPMJAX_INLINE R by_node(const Four& first) {
  const auto four = widened<typename R::Four>(first);
  return R::of([&](auto k) MPMJAX_INLINE_LAMBDA {
    return shuffled<typename R::Part>(four, nodes_of<R, decltype(k)::value>(Count<R::lanes>()));
  });
}

// A row that has the same columns at each node.
template <class R, class Four>
MPMJAX_INLINE R at_each(const Four& first) {
  const auto part = shuffled<typename R::Part>(widened<typename R::Four>(first), columns_of<R>(Count<R::lanes>()));
  return R::of([&](int) MPMJAX_INLINE_LAMBDA { return part; });
}

// Which lanes belong to a node and to the first so many of its columns.
template <class R>
struct LaneMask {
  typename R::Mask lanes[R::count];

  explicit MPMJAX_INLINE LaneMask(int used) {
    for (int k = 0; k < R::count; ++k) {
      for (int lane = 0; lane < R::lanes; ++lane) {
        lanes[k][lane] = R::node(k, lane) >= 0 && lane % R::columns < used ? -1 : 0;
      }
    }
  }

  // Zero in all other lanes.
  MPMJAX_INLINE R of(const R& row) const {
    return R::of([&](int k) MPMJAX_INLINE_LAMBDA {
      return (typename R::Part)((typename R::Mask)row.parts[k] & lanes[k]);
    });
  }
};

}  // namespace
