// The resistance of particles to a displacement of the nodes: f_i = Σ_p Σ_b g_ip,b r_p,b with r_p = K_p G_p and
// G_p,b = Σ_j g_jp,b u_j. A gather, a symmetric matrix for each particle and a scatter, of which nothing is stored.

#pragma once

#include "gather.h"
#include "scatter.h"

namespace {

using mpmjax::Resist;

// r_p for the particles of a block, as a row for each direction.
template <class T, int d, int s>
MPMJAX_INLINE void resist_block(const Resist<T>& task, const Block<T, d, s, false>& block, int64_t start, int count,
                                Vector<T> (*rows)[kBlock]) {
  const NodeRows<T> nodes(task.moved, task.size, d, 0);
  for (int q = 0; q < kBlock; ++q) {  // beyond the count weights are zero and the index is 0
    const auto put = [&](const auto& found) MPMJAX_INLINE_LAMBDA {
      for (int b = 0; b < d; ++b) rows[b][q] = found.gradients[b];
    };
    if (nodes.holds(block.least[q], block.most[q])) {
      put(Gatherer<T, d, s, false, true>{block, nodes, q}.template sums<0>(0));
    } else {
      put(Gatherer<T, d, s, false, false>{block, nodes, q}.template sums<0>(0));
    }
  }
  // Lanes beyond the d-th are split and joined, and nothing else.
  alignas(64) T slopes[d][kLanes][kBlock], found[d][kLanes][kBlock] = {}, entry[kBlock];
  for (int b = 0; b < d; ++b) split<T>(rows[b], slopes[b]);
  const T* from = task.matrices + start;
  for (int i = 0; i < d * d; ++i) {
    for (int j = i; j < d * d; ++j, from += task.stencils.particles) {
      copy(from, count, entry);
      T *to_i = found[i / d][i % d], *to_j = found[j / d][j % d];
      const T *by_i = slopes[i / d][i % d], *by_j = slopes[j / d][j % d];
      for (int q = 0; q < kBlock; ++q) to_i[q] += entry[q] * by_j[q];
      for (int q = 0; q < kBlock && i != j; ++q) to_j[q] += entry[q] * by_i[q];
    }
  }
  for (int b = 0; b < d; ++b) join<T>(found[b], rows[b]);
}

// Sets the nodes of a range.
template <class T, int d, int s>
void resist(const Resist<T>& task, int64_t first, int64_t last) {
  std::memset(task.nodes + first * d, 0, static_cast<size_t>((last - first) * d) * sizeof(T));
  const NodeSums<T, d> nodes{task.nodes, d, first, last, d};
  const auto give = [&](const auto& block, int64_t start, int count, auto& rows) MPMJAX_INLINE_LAMBDA {
    std::memset(rows[0], 0, sizeof rows[0]);
    resist_block<T, d, s>(task, block, start, count, rows + 1);
  };
  add_blocks<T, d, s, false, true, d>(task.stencils, task.ranges, nodes, give);
}

// Stores r_p,b, for a scatter.
template <class T, int d, int s>
void resist_particles(const Resist<T>& task, int64_t first, int64_t last) {
  for (int64_t start = first; start < last; start += kBlock) {
    const int count = smaller(last - start, kBlock);
    Block<T, d, s, false> block;
    block.find_range(task.stencils, start, count);
    block.read(task.stencils, start, count);
    Vector<T> rows[d][kBlock];
    resist_block<T, d, s>(task, block, start, count, rows);
    for (int b = 0; b < d; ++b) write_rows<T>(rows[b], task.sums[b + 1] + start, task.stencils.particles, count, d);
  }
}

}  // namespace
