// The scatter: f_i = Σ_p (w_ip a_p + Σ_b g_ip,b a_p,b).
//
// It sets the nodes of a range, from all particles in their order. Ranges of different threads share no node, so there
// is no race and nothing to add up afterwards, and the sums have the same bits however the nodes are divided.

#pragma once

#include "block.h"

namespace {

using mpmjax::Range;
using mpmjax::Scatter;

// Up to four columns of the nodes from a first to a last one. How many is known when this is compiled, or where speed
// matters less than the size of the code it is 0 and `count` says it.
template <class T, int used>
struct NodeSums {
  T* nodes;  // at the first of the columns
  int64_t columns, first, last;
  int count;

  // Whether any of the nodes from a least to a most may be in the range.
  MPMJAX_INLINE bool may_have(int64_t least, int64_t most) const { return most >= first && least < last; }

  template <bool inside>
  MPMJAX_INLINE void add(int32_t node, Vector<T> row) const {
    if (!inside && (node < first || node >= last)) return;
    T* to = nodes + node * columns;
    if constexpr (used > 0) {
      add_some<used>(to, row);
    } else {
      for (int c = 0; c < count; ++c) to[c] += row[c];
    }
  }
};

// One step further in: what a particle gives, times the factors of one node along axis a. Gradients are those of the
// axes from a on.
template <class T, int d, int s, bool differential, bool inside, int used>
struct Scatterer {
  const Block<T, d, s, differential>& block;
  const NodeSums<T, used>& nodes;
  int q;

  // With gradients.
  template <int a, class X>
  MPMJAX_INLINE void add(int32_t first, X value, const X* gradients) const {
    if constexpr (a == d) {
      nodes.template add<inside>(first, result(value));
    } else {
      each<s, inside && !differential && a + 1 >= d>([&](int i) MPMJAX_INLINE_LAMBDA {
        if constexpr (!inside && a == 0) {
          const int64_t term = block.index[0][i][q];
          if (!nodes.may_have(term + block.least_beyond[q], term + block.most_beyond[q])) return;
        }
        const auto w = block.weight(a, i, q), g = block.derivative(a, i, q);
        using Y = decltype(product(w, value));
        const Y narrow = product(w, value) + product(g, gradients[0]);
        Y inner[d - a];
        for (int b = 1; b < d - a; ++b) inner[b - 1] = product(w, gradients[b]);
        add<a + 1>(after(first, block.index[a][i][q]), narrow, inner);
      });
    }
  }

  // Without.
  template <int a, class X>
  MPMJAX_INLINE void add(int32_t first, X value) const {
    if constexpr (a == d) {
      nodes.template add<inside>(first, result(value));
    } else {
      each<s, false>([&](int i) MPMJAX_INLINE_LAMBDA {
        add<a + 1>(after(first, block.index[a][i][q]), product(block.weight(a, i, q), value));
      });
    }
  }
};

// The ranges of all blocks from a first to a last.
template <class T, int d, int s>
void find_ranges(const Stencils<T>& stencils, int64_t first, int64_t last, Range* ranges) {
  for (int64_t k = first; k < last; ++k) {
    const int count = smaller(stencils.particles - k * kBlock, kBlock);
    Block<T, d, s, false> block;
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
template <class T, int d, int s, bool differential, bool graded, int used, class Give>
MPMJAX_INLINE void add_blocks(const Stencils<T>& stencils, const Range* ranges, const NodeSums<T, used>& nodes,
                              const Give& give) {
  const int64_t particles = stencils.particles;
  for (int64_t start = 0; start < particles; start += kBlock) {
    if (ranges != nullptr && !nodes.may_have(ranges[start / kBlock].least, ranges[start / kBlock].most)) continue;
    const int count = smaller(particles - start, kBlock);
    Block<T, d, s, differential> block;
    block.find_range(stencils, start, count);
    int taken[kBlock], some = 0;
    for (int q = 0; q < count; ++q) {
      taken[some] = q;
      some += nodes.may_have(block.least[q], block.most[q]) ? 1 : 0;
    }
    if (some == 0) continue;
    block.read(stencils, start, count);
    Vector<T> rows[graded ? d + 1 : 1][kBlock];
    give(block, start, count, rows);
    for (int k = 0; k < some; ++k) {
      const int q = taken[k];
      const auto add = [&](const auto& scatterer) MPMJAX_INLINE_LAMBDA {
        if constexpr (graded) {
          Vector<T> gradients[d];
          for (int b = 0; b < d; ++b) gradients[b] = rows[b + 1][q];
          scatterer.template add<0>(0, rows[0][q], gradients);
        } else {
          scatterer.template add<0>(0, rows[0][q]);
        }
      };
      if (block.least[q] >= nodes.first && block.most[q] < nodes.last) {
        add(Scatterer<T, d, s, differential, true, used>{block, nodes, q});
      } else {
        add(Scatterer<T, d, s, differential, false, used>{block, nodes, q});
      }
    }
  }
}

// The particles' share in four columns or fewer, for a range of nodes that is zero at first.
template <class T, int d, int s, bool differential, bool graded, int used>
void scatter_columns(const Scatter<T>& task, int64_t column, int64_t first, int64_t last) {
  const int64_t particles = task.stencils.particles;
  const int width = used > 0 ? used : smaller(task.columns - column, kLanes);
  const NodeSums<T, used> nodes{task.nodes + column, task.columns, first, last, width};
  const auto give = [&](const auto&, int64_t start, int count, auto& rows) MPMJAX_INLINE_LAMBDA {
    for (int b = 0; b < (graded ? d + 1 : 1); ++b) {
      if (task.given[b] == nullptr) {
        std::memset(rows[b], 0, sizeof rows[b]);
      } else {
        read_rows(task.given[b] + column * particles + start, particles, count, width, rows[b]);
      }
    }
  };
  add_blocks<T, d, s, differential, graded, used>(task.stencils, task.ranges, nodes, give);
}

template <class T, int d, int s, bool differential, bool graded>
void scatter_given(const Scatter<T>& task, int64_t first, int64_t last) {
  const int64_t columns = task.columns;
  std::memset(task.nodes + first * columns, 0, static_cast<size_t>((last - first) * columns) * sizeof(T));
  int64_t c = 0;
  if constexpr (graded && !differential) {
    for (; c + 4 <= columns; c += 4) scatter_columns<T, d, s, false, true, 4>(task, c, first, last);
    switch (columns - c) {
      case 3: return scatter_columns<T, d, s, false, true, 3>(task, c, first, last);
      case 2: return scatter_columns<T, d, s, false, true, 2>(task, c, first, last);
      case 1: return scatter_columns<T, d, s, false, true, 1>(task, c, first, last);
    }
  } else {
    for (; c < columns; c += kLanes) scatter_columns<T, d, s, differential, graded, 0>(task, c, first, last);
  }
}

template <class T, int d, int s, bool differential>
void scatter(const Scatter<T>& task, int64_t first, int64_t last) {
  if (task.given[1] == nullptr) {
    scatter_given<T, d, s, differential, false>(task, first, last);
  } else {
    scatter_given<T, d, s, differential, true>(task, first, last);
  }
}

}  // namespace
