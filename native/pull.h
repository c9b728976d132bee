// The pull: the derivative of B = Σ_ip f_i · (w_ip a_p + Σ_b g_ip,b a_p,b) by the offset along each axis.
//
// By a weight or slope along axis a, B is a product of what the axes before it and the last narrow and what those after it
// gather; by one along the last axis it is a product of what is given and what all other axes gather. Each product counts
// times the derivative of that weight or slope. The gather comes out beside it.

#pragma once

#include "gather.h"

namespace {

using mpmjax::Pull;

template <class T, int d, int s, bool inside, int columns>
struct Puller {
  const Block<T, d, s>&block, &derivatives;
  const NodeRows<T, s, columns>& rows;
  int q;

  static constexpr int last = d - 1;
  using R = RowOf<T, s, columns>;

  // Adds the derivatives by the offsets along the axes from a on but the last, each as a row to be summed, and returns the
  // sums over these axes.
  template <int a>
  MPMJAX_INLINE Sums<R, last - a> pull(int32_t first, R value, const R* gradients, R* by_offset) const {
    Sums<R, last - a> total = {};
    if constexpr (a == last) {
      total.value = rows.template only<inside>(block, q, first);
    } else {
      each<s, inside && a + 1 >= last>([&](int i) MPMJAX_INLINE_LAMBDA {
        const T w = block.weights[a][i][q], g = block.slopes[a][i][q];
        R inner[d - a];
        for (int b = 1; b < last - a; ++b) inner[b - 1] = product(w, gradients[b]);
        const R narrow = product(w, value) + product(g, gradients[0]);
        const auto result = pull<a + 1>(wrapping_sum(first, block.index[a][i][q]), narrow, inner, by_offset);
        R by_weight = product(value, result.value);
        for (int b = 1; b < last - a; ++b) by_weight = by_weight + product(gradients[b], result.gradients[b - 1]);
        by_offset[a] = by_offset[a] + product(derivatives.weights[a][i][q], by_weight) +
                       product(derivatives.slopes[a][i][q], product(gradients[0], result.value));
        total.value = total.value + product(w, result.value);
        total.gradients[0] = total.gradients[0] + product(g, result.value);
        for (int b = 1; b < last - a; ++b) {
          total.gradients[b] = total.gradients[b] + product(w, result.gradients[b - 1]);
        }
      });
    }
    return total;
  }

  // The derivatives by all offsets, of the particle's rows of four: add(a, by the offset), as four lanes to be summed.
  template <class Add>
  MPMJAX_INLINE void all(const Vector<T> (*values)[kRoom], const Add& add) const {
    const R w = block.template last_weight<R>(q), g = block.template last_slope<R>(q);
    const R value = at_each<R, T>(values[0][q]), along = at_each<R, T>(values[d][q]);
    R gradients[d], narrow[d], by_offset[d] = {};
    for (int b = 0; b < last; ++b) gradients[b] = at_each<R, T>(values[b + 1][q]), narrow[b] = product(w, gradients[b]);
    const auto result = pull<0>(0, product(w, value) + product(g, along), narrow, by_offset);
    R by_weight = product(value, result.value);
    for (int b = 0; b < last; ++b) by_weight = by_weight + product(gradients[b], result.gradients[b]);
    by_offset[last] = product(derivatives.template last_weight<R>(q), by_weight) +
                      product(derivatives.template last_slope<R>(q), product(along, result.value));
    for (int a = 0; a < d; ++a) add(a, sum(by_offset[a]));
  }
};

// The sums of each of a block's vectors.
template <class T>
MPMJAX_NOINLINE void add_lanes(const Vector<T>* from, int count, T* to) {
  alignas(64) T sums[kBlock];
  for (int q = 0; q < kBlock; q += kLanes) {
    Vector<T> turned[kLanes];
    transpose<T>(from + q, turned);
    store(sums + q, (turned[0] + turned[1]) + (turned[2] + turned[3]));
  }
  write(sums, count, to);
}

// A block's particles abreast.
template <class T, int d, int s, int columns>
MPMJAX_INLINE void pull_fields(const Pull<T>& task, const Block<T, d, s>& block,
                               const Block<T, d, s>& derivatives, int64_t start) {
  using Some = Fields<T, d, s, columns>;
  using V = Simd<T>;
  const int64_t particles = task.stencils.particles;
  for (int q = 0; q < kBlock; q += kSimdLanes<T>) {
    const int64_t first = start + q;
    V values[d + 1][columns] = {};
    for (int c = 0; c < columns; ++c) {
      if (task.values.value != nullptr) std::memcpy(&values[0][c], task.values.value + c * particles + first, sizeof(V));
      for (int b = 0; b < d && c < task.values.graded; ++b) {
        const int64_t row = b * task.values.graded + c;
        std::memcpy(&values[b + 1][c], task.values.gradients + row * particles + first, sizeof(V));
      }
    }
    Some some(block, q, task.nodes, task.size);
    some.read_all();
    V by_offset[d];
    const auto result = some.pull(values, derivatives, by_offset);
    for (int a = 0; a < d; ++a) Some::put(by_offset[a], task.by_offset + a * particles + first);
    if (task.value != nullptr) some.write_sums(result, particles, task.value + first, task.gradients + first);
  }
}

template <class T, int d, int s, int columns>
void pull_columns(const Pull<T>& task, int64_t first, int64_t last) {
  const int64_t particles = task.stencils.particles;
  for (int64_t start = first; start < last; start += kBlock) {
    const int count = smaller(last - start, kBlock);
    Block<T, d, s> block, derivatives;
    block.find_range(task.stencils, start, count);
    block.evaluate(task.stencils, start, count);
    derivatives.differentiate(task.stencils, start, count);
    if constexpr (columns > 0) {
      if (has_fields<T, d, s, columns>(block, task.size)) {
        pull_fields<T, d, s, columns>(task, block, derivatives, start);
        continue;
      }
    }
    block.join_last(), derivatives.join_last();
    Vector<T> by_offset[d][kBlock];
    for (int64_t c = 0; c < (columns == 0 ? task.columns : columns); c += kLanes) {
      const NodeRows<T, s, columns> rows(task.nodes, task.size, task.columns, c);
      const LaneMask<Row<T, 1, kLanes, 1>> present(rows.used);
      Vector<T> values[d + 1][kRoom];
      read_values<T, d, true>(task.values, particles, c, rows.used, start, count, values);
      for (int q = 0; q < kBlock; ++q) {
        const auto add = [&](int a, Vector<T> result) MPMJAX_INLINE_LAMBDA {
          if constexpr (columns != kLanes) result = present.of({{result}}).parts[0];
          by_offset[a][q] = c == 0 ? result : by_offset[a][q] + result;
        };
        if (rows.holds(block, q)) {
          Puller<T, d, s, true, columns>{block, derivatives, rows, q}.all(values, add);
        } else {
          Puller<T, d, s, false, columns>{block, derivatives, rows, q}.all(values, add);
        }
      }
      if (task.value != nullptr) {
        const int64_t at = c * particles + start;
        gather_rows(block, rows, particles, task.columns, count, task.value + at, task.gradients + at);
      }
    }
    for (int a = 0; a < d; ++a) add_lanes<T>(by_offset[a], count, task.by_offset + a * particles + start);
  }
}

template <class T, int d, int s>
void pull(const Pull<T>& task, int64_t first, int64_t last) {
  if (task.columns == d) return pull_columns<T, d, s, d>(task, first, last);
  if (task.columns == d + 1) return pull_columns<T, d, s, d + 1>(task, first, last);
  pull_columns<T, d, s, 0>(task, first, last);
}

}  // namespace
