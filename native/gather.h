// The gather: a_p = Σ_i w_ip f_i and a_p,b = Σ_i g_ip,b f_i.

#pragma once

#include "field.h"
#include "node_rows.h"

namespace {

using mpmjax::Gather;

// The sums over the axes from a on: the value, and a gradient for each of these axes.
template <class X, int count>
struct Sums {
  X value;
  X gradients[count == 0 ? 1 : count];
};

// Each axis but the last takes the sums of rows over the axes after it one step further out: Σ_i over the nodes along
// it, of the value times weights and times slopes, of the gradients times weights. The last axis is summed at the
// end, within the row.
template <class T, int d, int s, bool inside, int columns>
struct Gatherer {
  const Block<T, d, s>& block;
  const NodeRows<T, s, columns>& rows;
  int q;

  static constexpr int last = d - 1;
  using R = RowOf<T, s, columns>;

  template <int a>
  MPMJAX_INLINE auto sums(int32_t first) const {
    if constexpr (a == last) {
      return Sums<R, 0>{rows.template at<inside>(block, q, first), {}};
    } else {
      Sums<R, last - a> total = {};
      each<s, inside>([&](int i) MPMJAX_INLINE_LAMBDA {
        const auto inner = sums<a + 1>(wrapping_sum(first, block.index[a][i][q]));
        const T w = block.weights[a][i][q], g = block.slopes[a][i][q];
        total.value = total.value + product(w, inner.value);
        total.gradients[0] = total.gradients[0] + product(g, inner.value);
        for (int b = 1; b < last - a; ++b) total.gradients[b] = total.gradients[b] + product(w, inner.gradients[b - 1]);
      });
      return total;
    }
  }

  // The value and all gradients, in four lanes of which those of the columns count.
  MPMJAX_INLINE Sums<Vector<T>, d> all() const {
    const auto w = block.template last_weight<R>(q), g = block.template last_slope<R>(q);
    const auto result = sums<0>(0);
    Sums<Vector<T>, d> total;
    total.value = sum(product(w, result.value));
    for (int b = 0; b < last; ++b) total.gradients[b] = sum(product(w, result.gradients[b]));
    total.gradients[last] = sum(product(g, result.value));
    return total;
  }
};

// The sums of a block's particles, each handed to put(q, sums).
template <class T, int d, int s, int columns, class Put>
MPMJAX_INLINE void gather_block(const Block<T, d, s>& block, const NodeRows<T, s, columns>& rows,
                                const Put& put) {
  for (int q = 0; q < kBlock; ++q) {  // beyond the count weights are zero and the index is 0
    if (rows.holds(block, q)) {
      put(q, Gatherer<T, d, s, true, columns>{block, rows, q}.all());
    } else {
      put(q, Gatherer<T, d, s, false, columns>{block, rows, q}.all());
    }
  }
}

// Some columns of a block, row by row, to where the block's particles begin, or added to what is there.
template <class T, int d, int s, int columns>
MPMJAX_INLINE void gather_rows(const Block<T, d, s>& block, const NodeRows<T, s, columns>& rows, int64_t particles,
                               int64_t all_columns, int count, T* value, T* gradients, bool add = false) {
  Vector<T> sums[d + 1][kBlock];
  gather_block(block, rows, [&](int q, const auto& result) MPMJAX_INLINE_LAMBDA {
    sums[0][q] = result.value;
    for (int b = 0; b < d; ++b) sums[b + 1][q] = result.gradients[b];
  });
  for (int b = 0; b <= d; ++b) {
    T* to = b == 0 ? value : gradients + (b - 1) * all_columns * particles;
    if (add) {
      Vector<T> before[kRoom];
      read_rows<T>(to, particles, count, rows.used, before);
      for (int q = 0; q < kBlock; ++q) sums[b][q] += before[q];
    }
    write_rows<T>(sums[b], to, particles, count, rows.used);
  }
}

template <class T, int d, int s, int columns>
void gather_columns(const Gather<T>& task, int64_t first, int64_t last) {
  const int64_t particles = task.stencils.particles;
  for (int64_t start = first; start < last; start += kBlock) {
    const int count = smaller(last - start, kBlock);
    Block<T, d, s> block;
    block.find_range(task.stencils, start, count);
    for (int pass = first_pass(task.stencils); pass < end_of_passes<d>(task.stencils); ++pass) {
      block.evaluate(task.stencils, start, count, pass);
      if constexpr (columns > 0) {
        if (has_fields<T, d, s, columns>(block, task.size)) {
          for (int q = 0; q < kBlock; q += kSimdLanes<T>) {
            const Fields<T, d, s, columns> some(block, q, task.nodes, task.size);
            const auto result = some.gather();
            for (int c = 0; c < columns; ++c) {
              const int64_t at = c * particles + start + q;
              some.put(result.value[c], task.value + at, pass > 0);
              for (int b = 0; b < d; ++b) {
                some.put(result.gradients[b][c], task.gradients + b * columns * particles + at, pass > 0);
              }
            }
          }
          continue;
        }
      }
      block.join_last();
      for (int64_t c = 0; c < task.columns; c += kLanes) {
        const NodeRows<T, s, columns> rows(task.nodes, task.size, task.columns, c);
        const int64_t at = c * particles + start;
        gather_rows(block, rows, particles, task.columns, count, task.value + at, task.gradients + at, pass > 0);
      }
    }
  }
}

template <class T, int d, int s>
void gather(const Gather<T>& task, int64_t first, int64_t last) {
  if (task.columns == d) return gather_columns<T, d, s, d>(task, first, last);
  if (task.columns == d + 1) return gather_columns<T, d, s, d + 1>(task, first, last);
  gather_columns<T, d, s, 0>(task, first, last);
}

}  // namespace
