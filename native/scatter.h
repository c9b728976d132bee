// The scatter: f_i = Σ_p (w_ip a_p + Σ_b g_ip,b a_p,b).
//
// It sets the nodes of a range, from all particles in their order; those of a block that follow each other and have the
// same nodes are added up first. Ranges of different threads share no node, so there is no race and nothing to add up
// afterwards, and the sums have the same bits however the nodes are divided.

#pragma once

#include "reach.h"

namespace {

using mpmjax::Scatter;

// Columns of the nodes from a first to a last one: all columns, or where `columns` is 0 up to four.
template <class T, int s, int columns>
struct NodeSums {
  using R = RowOf<T, s, columns>;

  T* nodes;  // at the first of the columns
  int64_t row_stride, first, last;
  int64_t extent;  // how many numbers there are from `nodes` to the last of the range
  int used;
  LaneMask<R> present;

  MPMJAX_INLINE NodeSums(T* whole, int64_t c, int64_t column, int64_t first, int64_t last)
      : nodes(whole + column), row_stride(c), first(first), last(last), extent(last * c - column),
        used(smaller(c - column, R::columns)), present(used) {}

  MPMJAX_INLINE int64_t stride() const { return columns == 0 ? row_stride : columns; }

  // Whether any of the nodes from a least to a most may be in the range.
  MPMJAX_INLINE bool may_have(int64_t least, int64_t most) const { return most >= first && least < last; }

  // Whether rows can be added in whole parts for a particle of a block: all that these reach over is in the range, and
  // zeros may be added to what comes after a row.
  template <class B>
  MPMJAX_INLINE bool holds(const B& block, int q) const {
    return block.contiguous[q] && block.least[q] >= first && block.most[q] < last &&
           (block.most[q] - (s - 1)) * stride() + R::reach(stride()) <= extent;
  }

  // Adds to the row whose index along the axes before the last adds up to `first`.
  template <bool inside, class B>
  MPMJAX_INLINE void add(const B& block, int q, int32_t first, const R& row) const {
    constexpr int axis = B::axes - 1;
    const int32_t node = wrapping_sum(first, block.index[axis][0][q]);
    if (inside || (block.contiguous[q] && holds_row(node))) {
      T* to = nodes + node * stride();
      const R added = present.of(row);
      // All is read before anything is written: a part's last lanes may be the next one's first, which writes them last.
      const R sums = row_of<R>([&](int k) MPMJAX_INLINE_LAMBDA {
        typename R::Part result;
        std::memcpy(&result, to + k * R::together * stride(), sizeof result);
        return result + added.parts[k];
      });
      each<R::count, true>([&](int k) MPMJAX_INLINE_LAMBDA {
        std::memcpy(to + k * R::together * stride(), &sums.parts[k], sizeof(typename R::Part));
      });
    } else {
      int32_t index[s];
      for (int i = 0; i < s; ++i) index[i] = wrapping_sum(first, block.index[axis][i][q]);
      const R apart = row;  // so that the row itself needs no place in memory
      add_apart(index, apart);
    }
  }

  // The same of the row of nodes that follow one another from this one on.
  MPMJAX_INLINE bool holds_row(int64_t node) const {
    return node >= first && node + s <= last && node * stride() + R::reach(stride()) <= extent;
  }

  // Adds to any nodes, of which those beyond the range are passed over.
  MPMJAX_NOINLINE void add_apart(const int32_t* index, const R& row) const {
    alignas(R) T numbers[R::count * R::lanes];
    std::memcpy(numbers, &row, sizeof row);
    for (int i = 0; i < s; ++i) {
      if (index[i] < first || index[i] >= last) continue;
      T* to = nodes + index[i] * stride();
      for (int c = 0; c < used; ++c) to[c] += numbers[R::place(i) + c];
    }
  }
};

// What particles with the same nodes give to all rows, in C order of the axes before the last. Gradients are those of the
// axes from a on, without the last.
template <class T, int d, int s, int columns>
struct Scatterer {
  using R = RowOf<T, s, columns>;
  static constexpr int last = d - 1, rows = power(s, last);

  const Block<T, d, s>& block;
  R sums[rows] = {};

  // With gradients: the particle's rows of four. The last axis is the first to be multiplied by, within the row.
  MPMJAX_INLINE void add_graded(int q, const Vector<T> (*values)[kRoom]) {
    const R w = block.template last_weight<R>(q), g = block.template last_slope<R>(q);
    const R value = product(w, at_each<R, T>(values[0][q])) + product(g, at_each<R, T>(values[d][q]));
    R gradients[d];
    for (int b = 0; b < last; ++b) gradients[b] = product(w, at_each<R, T>(values[b + 1][q]));
    add<0>(q, 0, value, gradients);
  }

  // Without.
  MPMJAX_INLINE void add_value(int q, const Vector<T> (*values)[kRoom]) {
    add<0>(q, 0, product(block.template last_weight<R>(q), at_each<R, T>(values[0][q])));
  }

  // One step further in: the same times the factors of one node along axis a.
  template <int a>
  MPMJAX_INLINE void add(int q, int row, R value, const R* gradients) {
    if constexpr (a == last) {
      sums[row] = sums[row] + value;
    } else {
      each<s, true>([&](int i) MPMJAX_INLINE_LAMBDA {
        const T w = block.weights[a][i][q], g = block.slopes[a][i][q];
        if constexpr (a + 1 == last) {  // so that both products are added as they are formed
          sums[s * row + i] = sums[s * row + i] + product(w, value) + product(g, gradients[0]);
        } else {
          R inner[d - a];
          for (int b = 1; b < last - a; ++b) inner[b - 1] = product(w, gradients[b]);
          add<a + 1>(q, s * row + i, product(w, value) + product(g, gradients[0]), inner);
        }
      });
    }
  }

  template <int a>
  MPMJAX_INLINE void add(int q, int row, R value) {
    if constexpr (a == last) {
      sums[row] = sums[row] + value;
    } else {
      each<s, true>([&](int i) MPMJAX_INLINE_LAMBDA {
        add<a + 1>(q, s * row + i, product(block.weights[a][i][q], value));
      });
    }
  }

  // Adds all rows to the nodes of one of the particles.
  template <bool inside>
  MPMJAX_INLINE void put(const NodeSums<T, s, columns>& nodes, int q) const {
#pragma GCC unroll 16
    for (int row = 0; row < rows; ++row) {
      int32_t first = 0;
      if constexpr (d == 2) first = block.index[0][row][q];
      if constexpr (d == 3) first = wrapping_sum(block.index[0][row / s][q], block.index[1][row % s][q]);
      nodes.template add<inside>(block, q, first, sums[row]);
    }
  }
};

// The ranges of all blocks from a first to a last.
template <class T, int d, int s>
void find_ranges(const Stencils<T>& stencils, int64_t first, int64_t last, Range* ranges) {
  for (int64_t k = first; k < last; ++k) {
    const int count = smaller(stencils.particles - k * kBlock, kBlock);
    Block<T, d, s> block;
    block.find_range(stencils, k * kBlock, count);
    Range range = {block.least[0], block.most[0]};
    for (int q = 1; q < count; ++q) {
      range.least = block.least[q] < range.least ? block.least[q] : range.least;
      range.most = block.most[q] > range.most ? block.most[q] : range.most;
    }
    ranges[k] = range;
  }
}

// Adds what all particles give to a range of nodes, in four columns or fewer. `give(block, start, count, rows)` makes it
// of a block: for each particle the row of its value, and with `graded` then those of its gradients.
template <class T, int d, int s, bool graded, int columns, class Give>
MPMJAX_INLINE void add_blocks(const Stencils<T>& stencils, const Range* ranges, const NodeSums<T, s, columns>& nodes,
                              const Give& give) {
  const int64_t particles = stencils.particles;
  for (int64_t start = 0; start < particles; start += kBlock) {
    if (ranges != nullptr && !nodes.may_have(ranges[start / kBlock].least, ranges[start / kBlock].most)) continue;
    const int count = smaller(particles - start, kBlock);
    Block<T, d, s> block;
    block.find_range(stencils, start, count);
    int taken[kBlock], some = 0;
    for (int q = 0; q < count; ++q) {
      taken[some] = q;
      some += nodes.may_have(block.least[q], block.most[q]) ? 1 : 0;
    }
    if (some == 0) continue;
    block.find_same_nodes();
    for (int pass = first_pass(stencils); pass < end_of_passes<d>(stencils); ++pass) {
      block.evaluate(stencils, start, count, pass);
      block.join_last();
      Vector<T> rows[graded ? d + 1 : 1][kRoom];
      give(block, start, count, rows);
      for (int k = 0; k < some;) {
        Scatterer<T, d, s, columns> scatterer{block};
        const int q = taken[k];
        do {
          if constexpr (graded) {
            scatterer.add_graded(taken[k], rows);
          } else {
            scatterer.add_value(taken[k], rows);
          }
        } while (++k < some && block.same_nodes[taken[k]]);
        nodes.holds(block, q) ? scatterer.template put<true>(nodes, q) : scatterer.template put<false>(nodes, q);
      }
    }
  }
}

// Adds to a range of nodes all columns, or where `columns` is 0 up to four from a first one.
template <class T, int d, int s, bool graded, int columns>
void scatter_columns(const Scatter<T>& task, int64_t column, int64_t first, int64_t last) {
  const int64_t particles = task.stencils.particles;
  const NodeSums<T, s, columns> nodes(task.nodes, task.columns, column, first, last);
  const auto give = [&](const auto&, int64_t start, int count, auto& rows) MPMJAX_INLINE_LAMBDA {
    read_values<T, d, graded>(task.values, particles, column, nodes.used, start, count, rows);
  };
  add_blocks<T, d, s, graded, columns>(task.stencils, task.ranges, nodes, give);
}

// Adds to a range of nodes.
template <class T, int d, int s>
void add_all(const Scatter<T>& task, int64_t first, int64_t last) {
  const bool graded = task.values.gradients != nullptr;
  if (graded && task.columns == d) return scatter_columns<T, d, s, true, d>(task, 0, first, last);
  if (graded && task.columns == d + 1) return scatter_columns<T, d, s, true, d + 1>(task, 0, first, last);
  for (int64_t c = 0; c < task.columns; c += kLanes) {
    if (graded) {
      scatter_columns<T, d, s, true, 0>(task, c, first, last);
    } else {
      scatter_columns<T, d, s, false, 0>(task, c, first, last);
    }
  }
}

template <class T, int d, int s>
void scatter(const Scatter<T>& task, int64_t first, int64_t last) {
  const int64_t columns = task.columns;
  if (task.reached == nullptr) {
    clear(task.nodes, task.wanted, first * columns, last * columns);
  } else {
    mark<T, d, s>(task.stencils, task.ranges, task.reached, first, last);
    over_reached(task.reached, first, last, [&](bool reached, int64_t from, int64_t to) {
      if (reached) {
        clear(task.nodes, nullptr, from * columns, to * columns);
      } else {
        wipe(task.nodes, task.size * columns, from * columns, to * columns);
      }
    });
  }
  add_all<T, d, s>(task, first, last);
}

}  // namespace
