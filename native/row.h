// Rows: what the nodes of a stencil along the last axis have, some columns at each.
//
// These nodes follow each other in memory, so that several make one vector. A sum over a stencil's nodes is then one over
// its rows, and only at one end of it over the nodes of a row.

#pragma once

#include <utility>

#include "vector.h"

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

  using Number = T;
  typedef T Part __attribute__((vector_size(lanes * sizeof(T))));
  typedef typename LanesOf<T, lanes>::type Mask;
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
};

// All columns of the nodes, or where their number is 0 when this is compiled, four of any number.
template <class T, int s, int columns>
using RowOf = Row<T, s, columns == 0 ? kLanes : columns, columns == 0 ? 1 : fitting<T>(s, columns)>;

template <class R, class F>
MPMJAX_INLINE R row_of(const F& part) {
  R row;
  each<R::count, true>([&](auto k) MPMJAX_INLINE_LAMBDA { row.parts[k] = part(k); });
  return row;
}

template <class T, int s, int c, int t>
MPMJAX_INLINE Row<T, s, c, t> product(T a, Row<T, s, c, t> x) {
  return row_of<Row<T, s, c, t>>([&](int k) MPMJAX_INLINE_LAMBDA { return a * x.parts[k]; });
}

template <class T, int s, int c, int t>
MPMJAX_INLINE Row<T, s, c, t> product(Row<T, s, c, t> a, Row<T, s, c, t> x) {
  return row_of<Row<T, s, c, t>>([&](int k) MPMJAX_INLINE_LAMBDA { return a.parts[k] * x.parts[k]; });
}

template <class T, int s, int c, int t>
MPMJAX_INLINE Row<T, s, c, t> operator+(Row<T, s, c, t> a, Row<T, s, c, t> b) {
  return row_of<Row<T, s, c, t>>([&](int k) MPMJAX_INLINE_LAMBDA { return a.parts[k] + b.parts[k]; });
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
template <class V, class M, int... lane>
MPMJAX_INLINE V shuffled(V a, V b, M, std::integer_sequence<int, lane...>) {
#if defined(__clang__) || __GNUC__ >= 12
  return __builtin_shufflevector(a, b, lane...);
#else
  return __builtin_shuffle(a, b, M{lane...});
#endif
}

template <int count>
using Count = std::make_integer_sequence<int, count>;

// For the lanes of a part, their nodes and their columns; and the lanes of a part that its i-th node has, four with what
// is beyond its columns.
template <class R, int part, int... lane>
constexpr auto nodes_of(std::integer_sequence<int, lane...>) {
  return std::integer_sequence<int, R::node(part, lane)...>();
}
template <class R, int... lane>
constexpr auto columns_of(std::integer_sequence<int, lane...>) {
  return std::integer_sequence<int, (lane < R::together * R::columns ? lane % R::columns : -1)...>();
}
template <class R, int i, int... lane>
constexpr auto lanes_of(std::integer_sequence<int, lane...>) {
  return std::integer_sequence<int, (lane < R::columns ? i * R::columns + lane : -1)...>();
}

// Four numbers, read with as many of those that follow them as a part has.
template <class R>
struct FourFor {
  static constexpr int lanes = R::lanes > kLanes ? R::lanes : kLanes;
  typedef typename R::Number type __attribute__((vector_size(lanes * sizeof(typename R::Number))));
};
template <class R, class T>
MPMJAX_INLINE auto read_four(const Vector<T>& first) {
  typename FourFor<R>::type four;
  std::memcpy(&four, &first, sizeof four);
  return four;
}

// A row that has at each node its own of four numbers, in all columns.
template <class R, class T>
MPMJAX_INLINE R by_node(const Vector<T>& first) {
  const auto four = read_four<R, T>(first);
  return row_of<R>([&](auto k) MPMJAX_INLINE_LAMBDA {
    return shuffled<typename R::Part>(four, nodes_of<R, decltype(k)::value>(Count<R::lanes>()));
  });
}

// A row that has the same columns at each node.
template <class R, class T>
MPMJAX_INLINE R at_each(const Vector<T>& first) {
  const auto part = shuffled<typename R::Part>(read_four<R, T>(first), columns_of<R>(Count<R::lanes>()));
  return row_of<R>([&](int) MPMJAX_INLINE_LAMBDA { return part; });
}

// The columns of the i-th node in four lanes, of which others hold anything.
template <int i, class R>
MPMJAX_INLINE auto columns_at(const R& row) {
  constexpr int part = i / R::together, place = i % R::together;
  return shuffled<Vector<typename R::Number>>(row.parts[part], lanes_of<R, place>(Count<kLanes>()));
}

// The sum of these over the nodes.
template <class R>
MPMJAX_INLINE auto sum(const R& row) {
  auto total = columns_at<0>(row);
  each<R::s - 1, true>([&](auto i) MPMJAX_INLINE_LAMBDA { total += columns_at<decltype(i)::value + 1>(row); });
  return total;
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
    return row_of<R>([&](int k) MPMJAX_INLINE_LAMBDA {
      return (typename R::Part)((typename R::Mask)row.parts[k] & lanes[k]);
    });
  }
};

}  // namespace
