// The row of a node, read for a gather or a pull.

#pragma once

#include "block.h"

namespace {

// Four columns of the nodes (n, c), from a first column. An index beyond the window is clipped to its ends, as in XLA's
// gather with mode "clip".
template <class T>
struct NodeRows {
  const T* nodes;  // at the first of the four columns
  int64_t size, columns;
  int64_t extent;  // how many numbers there are from `nodes` on
  int used;        // columns from the first on, at most four
  Lanes<T> present;

  MPMJAX_INLINE NodeRows(const T* whole, int64_t n, int64_t c, int64_t column)
      : nodes(whole + column), size(n), columns(c), extent(n * c - column), used(smaller(c - column, kLanes)) {
    for (int lane = 0; lane < kLanes; ++lane) present[lane] = lane < used ? -1 : 0;
  }

  // Whether four numbers can be read at all nodes of a range. Where there are fewer columns they reach into the next
  // row, which the last one has not.
  MPMJAX_INLINE bool holds(int64_t least, int64_t most) const {
    return least >= 0 && most < size && most * columns + kLanes <= extent;
  }

  // Lanes beyond the columns hold anything, such as what comes next in memory.
  template <bool inside>
  MPMJAX_INLINE Vector<T> at(int32_t node) const {
    if constexpr (inside) {
      return load(nodes + node * columns);
    } else {
      const int64_t clipped = node < 0 ? 0 : node >= size ? size - 1 : node;
      return load_some(nodes + clipped * columns, used);
    }
  }

  // Lanes beyond the columns are zero.
  template <bool inside>
  MPMJAX_INLINE Vector<T> only(int32_t node) const {
    return (Vector<T>)((Lanes<T>)at<inside>(node) & present);
  }
};

}  // namespace
