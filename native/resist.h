// The resistance of particles to a displacement of the nodes: f_i = Σ_p Σ_b g_ip,b r_p,b with r_p = K_p G_p and
// G_p,b = Σ_j g_jp,b u_j. A gather, a symmetric matrix for each particle and a scatter, of which nothing is stored.

#pragma once

#include "gather.h"
#include "scatter.h"

namespace {

using mpmjax::Resist;

// The components of a gradient of a block's particles, those along the first axis first.
template <class T, int d>
using Components = T[d * d][kBlock];

// K G for a block, some particles at once, with all sums in registers. K's entries are a stride apart.
template <class T, int d>
MPMJAX_NOINLINE void multiply(const T* entries, int64_t stride, const Components<T, d>& slopes,
                              Components<T, d>& products) {
  constexpr int bytes = 64, step = bytes / sizeof(T), m = d * d;
  typedef T Wide __attribute__((vector_size(bytes)));
  for (int q = 0; q < kBlock; q += step) {
    Wide slope[m], sum[m] = {}, entry;
    for (int i = 0; i < m; ++i) std::memcpy(&slope[i], slopes[i] + q, bytes);
    const T* from = entries + q;
#pragma GCC unroll 9
    for (int i = 0; i < m; ++i) {
#pragma GCC unroll 9
      for (int j = i; j < m; ++j, from += stride) {
        prefetch(from);
        std::memcpy(&entry, from, bytes);
        sum[i] += entry * slope[j];
        if (j > i) sum[j] += entry * slope[i];
      }
    }
    for (int i = 0; i < m; ++i) std::memcpy(products[i] + q, &sum[i], bytes);
  }
}

// r_p for the particles of a block.
template <class T, int d, int s>
MPMJAX_NOINLINE void resist_block(const Resist<T>& task, const Block<T, d, s>& block, int64_t start, int count,
                                  Components<T, d>& products) {
  constexpr int entries = mpmjax::matrix_entries(d);
  const int64_t particles = task.stencils.particles;
  alignas(64) Components<T, d> slopes;
  for (int q = 0; q < kBlock; q += kSimdLanes<T>) {
    const auto result = Nodes<T, d, s, d>(block, q, task.moved, task.size, d, 0).gather();
    for (int b = 0; b < d; ++b) {
      for (int c = 0; c < d; ++c) store(slopes[b * d + c] + q, result.gradients[b][c]);
    }
  }
  if (count == kBlock) {
    multiply<T, d>(task.matrices + start, particles, slopes, products);
  } else {
    alignas(64) T few[entries][kBlock];
    for (int k = 0; k < entries; ++k) copy_partial(task.matrices + k * particles + start, count, few[k]);
    multiply<T, d>(few[0], kBlock, slopes, products);
  }
}

// Sets the nodes of a range.
template <class T, int d, int s>
void set_resisted(const Resist<T>& task, int64_t first, int64_t last) {
  clear(task.nodes, task.wanted, first * d, last * d);
  const NodeSums<T, s, d> nodes(task.nodes, d, 0, first, last);
  const auto give = [&](const auto& block, int64_t start, int count, auto& rows) MPMJAX_INLINE_LAMBDA {
    alignas(64) Components<T, d> products;
    resist_block<T, d, s>(task, block, start, count, products);
    std::memset(rows[0], 0, sizeof rows[0]);
    for (int b = 0; b < d; ++b) to_rows<T, d>(products + b * d, rows[b + 1]);
  };
  add_blocks<T, d, s, true, d>(task.stencils, task.ranges, nodes, give);
}

// Stores r_p,b of some particles, for a scatter.
template <class T, int d, int s>
void store_resisted(const Resist<T>& task, int64_t first, int64_t last) {
  for (int64_t start = first; start < last; start += kBlock) {
    const int count = smaller(last - start, kBlock);
    Block<T, d, s> block;
    block.find_range(task.stencils, start, count);
    block.evaluate(task.stencils, start, count);
    alignas(64) Components<T, d> products;
    resist_block<T, d, s>(task, block, start, count, products);
    for (int k = 0; k < d * d; ++k) write(products[k], count, task.gradients + k * task.stencils.particles + start);
  }
}

template <class T, int d, int s>
void resist(const Resist<T>& task, int64_t first, int64_t last) {
  task.gradients == nullptr ? set_resisted<T, d, s>(task, first, last) : store_resisted<T, d, s>(task, first, last);
}

}  // namespace
