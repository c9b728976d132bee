// The rows of nodes, read for a gather or a pull.

#pragma once

#include "block.h"

namespace {

// Columns of the nodes (n, c): all, or where `columns` is 0 up to four from a first one. An index beyond the window is
// clipped to its ends, as in XLA's gather with mode "clip".
template <class T, int s, int columns>
struct NodeRows {
  using R = RowOf<T, s, columns>;

  const T* nodes;  // at the first of the columns
  int64_t size, row_stride;
  int64_t extent;  // how many numbers there are from `nodes` on
  int used;        // columns from the first on
  LaneMask<R> present;

  MPMJAX_INLINE NodeRows(const T* whole, int64_t n, int64_t c, int64_t column)
      : nodes(whole + column), size(n), row_stride(c), extent(n * c - column), used(smaller(c - column, R::columns)),
        present(used) {}

  MPMJAX_INLINE int64_t stride() const { return columns == 0 ? row_stride : columns; }

  // Whether rows can be read in whole parts for a particle of a block: where there are lanes beyond the nodes of a row
  // they reach into what comes next, which the last row has not.
  template <class B>
  MPMJAX_INLINE bool holds(const B& block, int q) const {
    return block.contiguous[q] && block.least[q] >= 0 && block.most[q] < size &&
           (block.most[q] - (s - 1)) * stride() + R::reach(stride()) <= extent;
  }

  // The row whose index along the axes before the last adds up to `first`.
  template <bool inside, class B>
  MPMJAX_INLINE R at(const B& block, int q, int32_t first) const {
    constexpr int last = B::axes - 1;
    if constexpr (inside) {
      const T* from = nodes + wrapping_sum(first, block.index[last][0][q]) * stride();
      return row_of<R>([&](int k) MPMJAX_INLINE_LAMBDA {
        typename R::Part part;
        std::memcpy(&part, from + k * R::together * stride(), sizeof part);
        return part;
      });
    } else {
      int32_t index[s];
      for (int i = 0; i < s; ++i) index[i] = wrapping_sum(first, block.index[last][i][q]);
      return apart(index);
    }
  }

  // The row of any nodes, zero in other lanes.
  MPMJAX_NOINLINE R apart(const int32_t* index) const {
    alignas(R) T numbers[R::count * R::lanes] = {};
    for (int i = 0; i < s; ++i) {
      const int64_t clipped = index[i] < 0 ? 0 : index[i] >= size ? size - 1 : index[i];
      std::memcpy(numbers + R::place(i), nodes + clipped * stride(), used * sizeof(T));
    }
    R row;
    std::memcpy(&row, numbers, sizeof row);
    return row;
  }

  // The same, zero in other lanes wherever it lies.
  template <bool inside, class B>
  MPMJAX_INLINE R only(const B& block, int q, int32_t first) const {
    return present.of(at<inside>(block, q, first));
  }
};

}  // namespace
