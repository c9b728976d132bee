// The resistance of particles to a displacement of the nodes: f_i = Σ_p Σ_b g_ip,b r_p,b with r_p = K_p G_p and
// G_p,b = Σ_j g_jp,b u_j. A gather, a symmetric matrix for each particle and a scatter, of which nothing is stored.

#pragma once

#include "gather.h"
#include "scatter.h"

namespace {

using mpmjax::Resist;

// The rows of components of a block: those of a gradient along b are the first d of four from the (4 b)-th on, as they
// are split.
template <class T, int d>
using Components = T[d * kLanes][kBlock];

// K G for a block, some particles at once, with all sums in registers. K's entries are a stride apart.
template <class T, int d>
MPMJAX_NOINLINE void multiply(const T* entries, int64_t stride, const Components<T, d>& slopes,
                              Components<T, d>& products) {
  constexpr int bytes = 64, step = bytes / sizeof(T), m = d * d;
  typedef T Wide __attribute__((vector_size(bytes)));
  const auto place = [](int i) { return i / d * kLanes + i % d; };
  for (int q = 0; q < kBlock; q += step) {
    Wide slope[m], sum[m] = {}, entry;
    for (int i = 0; i < m; ++i) std::memcpy(&slope[i], slopes[place(i)] + q, bytes);
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
    for (int i = 0; i < m; ++i) std::memcpy(products[place(i)] + q, &sum[i], bytes);
  }
}

// r_p for the particles of a block, as a row for each direction.
template <class T, int d, int s>
MPMJAX_NOINLINE void resist_block(const Resist<T>& task, const Block<T, d, s>& block, int64_t start, int count,
                               Vector<T> (*rows)[kRoom]) {
  constexpr int entries = d * d * (d * d + 1) / 2;
  const int64_t particles = task.stencils.particles;
  alignas(64) Components<T, d> slopes, products = {};
  if (has_fields<T, d, s, d>(block, task.size)) {
    for (int q = 0; q < kBlock; q += kSimdLanes<T>) {
      const auto result = Fields<T, d, s, d>(block, q, task.moved, task.size).gather();
      for (int b = 0; b < d; ++b) {
        for (int c = 0; c < d; ++c) std::memcpy(slopes[b * kLanes + c] + q, &result.gradients[b][c], sizeof(Simd<T>));
      }
    }
  } else {
    const NodeRows<T, s, d> nodes(task.moved, task.size, d, 0);
    gather_block(block, nodes, [&](int q, const auto& result) MPMJAX_INLINE_LAMBDA {
      for (int b = 0; b < d; ++b) rows[b][q] = result.gradients[b];
    });
    for (int b = 0; b < d; ++b) to_columns<T>(rows[b], slopes + b * kLanes);
  }
  if (count == kBlock) {
    multiply<T, d>(task.matrices + start, particles, slopes, products);
  } else {
    alignas(64) T few[entries][kBlock];
    for (int k = 0; k < entries; ++k) copy_partial(task.matrices + k * particles + start, count, few[k]);
    multiply<T, d>(few[0], kBlock, slopes, products);
  }
  for (int b = 0; b < d; ++b) to_rows<T, kLanes>(products + b * kLanes, rows[b]);
}

// Sets the nodes of a range.
template <class T, int d, int s>
void resist(const Resist<T>& task, int64_t first, int64_t last) {
  clear(task.nodes, task.wanted, first * d, last * d);
  const NodeSums<T, s, d> nodes(task.nodes, d, 0, first, last);
  const auto give = [&](const auto& block, int64_t start, int count, auto& rows) MPMJAX_INLINE_LAMBDA {
    std::memset(rows[0], 0, sizeof rows[0]);
    resist_block<T, d, s>(task, block, start, count, rows + 1);
  };
  add_blocks<T, d, s, true, d>(task.stencils, task.ranges, nodes, give);
}

// Stores r_p,b, for a scatter.
template <class T, int d, int s>
void resist_particles(const Resist<T>& task, int64_t first, int64_t last) {
  for (int64_t start = first; start < last; start += kBlock) {
    const int count = smaller(last - start, kBlock);
    Block<T, d, s> block;
    block.find_range(task.stencils, start, count);
    block.evaluate(task.stencils, start, count);
    block.join_last();
    Vector<T> rows[d][kRoom];
    resist_block<T, d, s>(task, block, start, count, rows);
    const int64_t particles = task.stencils.particles;
    for (int b = 0; b < d; ++b) write_rows<T>(rows[b], task.gradients + b * d * particles + start, particles, count, d);
  }
}

}  // namespace
