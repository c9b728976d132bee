// The pull: the derivative of B = Σ_ip f_i · (w_ip a_p + Σ_b g_ip,b a_p,b) by the factors along each axis.
//
// By a factor along axis a, B is a product of what the axes before it narrow and what those after it gather.

#pragma once

#include "gather.h"

namespace {

using mpmjax::Pull;

// Four numbers for each factor, whose sum is the derivative by it.
template <class T, int d, int s>
struct Slopes {
  Vector<T> by_weights[d][s];
  Vector<T> by_derivatives[d][s];
};

template <class T, int d, int s, bool inside>
struct Puller {
  const Block<T, d, s, false>& block;
  const NodeRows<T>& rows;
  int q;

  // Adds the derivatives by the factors of the axes from a on, and returns the sums over these axes.
  template <int a>
  MPMJAX_INLINE Sums<Vector<T>, d - a> pull(int32_t first, Vector<T> value, const Vector<T>* gradients,
                                              Slopes<T, d, s>& slopes) const {
    Sums<Vector<T>, d - a> total = {};
    if constexpr (a == d) {
      total.value = rows.template only<inside>(first);
    } else {
      each<s, inside && a + 2 >= d>([&](int i) MPMJAX_INLINE_LAMBDA {
        const T w = block.weights[a][i][q], g = block.derivatives[a][i][q];
        Vector<T> inner[d - a];
        for (int b = 1; b < d - a; ++b) inner[b - 1] = w * gradients[b];
        const Vector<T> narrow = w * value + g * gradients[0];
        const auto found = pull<a + 1>(after(first, block.index[a][i][q]), narrow, inner, slopes);
        Vector<T> by_weight = value * found.value;
        for (int b = 1; b < d - a; ++b) by_weight += gradients[b] * found.gradients[b - 1];
        slopes.by_weights[a][i] += by_weight;
        slopes.by_derivatives[a][i] += gradients[0] * found.value;
        total.value += w * found.value;
        total.gradients[0] += g * found.value;
        for (int b = 1; b < d - a; ++b) total.gradients[b] += w * found.gradients[b - 1];
      });
    }
    return total;
  }
};

// The sums of each of a block's vectors.
template <class T>
MPMJAX_APART void add_lanes(const Vector<T>* from, int count, T* to) {
  alignas(64) T sums[kBlock];
  for (int q = 0; q < kBlock; q += kLanes) {
    Vector<T> turned[kLanes];
    transpose<T>(from + q, turned);
    store(sums + q, (turned[0] + turned[1]) + (turned[2] + turned[3]));
  }
  write(sums, count, to);
}

template <class T, int d, int s>
void pull(const Pull<T>& task, int64_t first, int64_t last) {
  const int64_t particles = task.stencils.particles;
  for (int64_t start = first; start < last; start += kBlock) {
    const int count = smaller(last - start, kBlock);
    Block<T, d, s, false> block;
    block.find_range(task.stencils, start, count);
    block.read(task.stencils, start, count);
    Vector<T> by_weights[d][s][kBlock] = {}, by_derivatives[d][s][kBlock] = {};
    for (int64_t c = 0; c < task.columns; c += kLanes) {
      const NodeRows<T> rows(task.nodes, task.size, task.columns, c);
      Vector<T> given[d + 1][kBlock];
      for (int b = 0; b <= d; ++b) {
        if (task.given[b] == nullptr) {
          std::memset(given[b], 0, sizeof given[b]);
        } else {
          read_rows(task.given[b] + c * particles + start, particles, count, rows.used, given[b]);
        }
      }
      for (int q = 0; q < kBlock; ++q) {
        Vector<T> gradients[d];
        for (int b = 0; b < d; ++b) gradients[b] = given[b + 1][q];
        Slopes<T, d, s> slopes = {};
        if (rows.holds(block.least[q], block.most[q])) {
          Puller<T, d, s, true>{block, rows, q}.template pull<0>(0, given[0][q], gradients, slopes);
        } else {
          Puller<T, d, s, false>{block, rows, q}.template pull<0>(0, given[0][q], gradients, slopes);
        }
        for (int a = 0; a < d; ++a) {
          for (int i = 0; i < s; ++i) {
            by_weights[a][i][q] += slopes.by_weights[a][i];
            by_derivatives[a][i][q] += slopes.by_derivatives[a][i];
          }
        }
      }
    }
    // What has no part in B is zero, also where it would be zero times what is not finite.
    if (task.given[1] == nullptr) std::memset(by_derivatives, 0, sizeof by_derivatives);
    if (task.given[0] == nullptr && d == 1) std::memset(by_weights, 0, sizeof by_weights);
    for (int a = 0; a < d; ++a) {
      for (int i = 0; i < s; ++i) {
        const int64_t at = (a * s + i) * particles + start;
        add_lanes<T>(by_weights[a][i], count, task.by_weights + at);
        add_lanes<T>(by_derivatives[a][i], count, task.by_derivatives + at);
      }
    }
  }
}

}  // namespace
