// The gather: a_p = Σ_i w_ip f_i and a_p,b = Σ_i g_ip,b f_i.

#pragma once

#include <type_traits>

#include "node_rows.h"

namespace {

using mpmjax::Gather;

// The sums over the axes from a on: the value, and a gradient for each of these axes.
template <class X, int count>
struct Sums {
  X value;
  X gradients[count == 0 ? 1 : count];
};

// Each axis takes the sums over the axes after it one step further out: Σ_i over the nodes along it, of the value times
// weights and times derivatives, of the gradients times weights.
template <class T, int d, int s, bool differential, bool inside>
struct Gatherer {
  const Block<T, d, s, differential>& block;
  const NodeRows<T>& rows;
  int q;

  using Number = typename std::conditional<differential, Dual<Vector<T>>, Vector<T>>::type;

  template <int a>
  MPMJAX_INLINE auto sums(int32_t first) const {
    if constexpr (a == d) {
      return Sums<Vector<T>, 0>{rows.template at<inside>(first), {}};
    } else {
      Sums<Number, d - a> total = {};
      each<s, inside && !differential && a + 1 >= d>([&](int i) MPMJAX_INLINE_LAMBDA {
        const auto inner = sums<a + 1>(after(first, block.index[a][i][q]));
        const auto w = block.weight(a, i, q), g = block.derivative(a, i, q);
        total.value = total.value + product(w, inner.value);
        total.gradients[0] = total.gradients[0] + product(g, inner.value);
        for (int b = 1; b < d - a; ++b) total.gradients[b] = total.gradients[b] + product(w, inner.gradients[b - 1]);
      });
      return total;
    }
  }
};

template <class T, int d, int s, bool differential>
void gather(const Gather<T>& task, int64_t first, int64_t last) {
  const int64_t particles = task.stencils.particles;
  for (int64_t start = first; start < last; start += kBlock) {
    const int count = smaller(last - start, kBlock);
    Block<T, d, s, differential> block;
    block.find_range(task.stencils, start, count);
    block.read(task.stencils, start, count);
    for (int64_t c = 0; c < task.columns; c += kLanes) {
      const NodeRows<T> rows(task.nodes, task.size, task.columns, c);
      Vector<T> sums[d + 1][kBlock];
      const auto put = [&](int q, const auto& found) MPMJAX_INLINE_LAMBDA {
        sums[0][q] = result(found.value);
        for (int b = 0; b < d; ++b) sums[b + 1][q] = result(found.gradients[b]);
      };
      for (int q = 0; q < kBlock; ++q) {  // beyond the count weights are zero and the index is 0
        if (rows.holds(block.least[q], block.most[q])) {
          put(q, Gatherer<T, d, s, differential, true>{block, rows, q}.template sums<0>(0));
        } else {
          put(q, Gatherer<T, d, s, differential, false>{block, rows, q}.template sums<0>(0));
        }
      }
      for (int b = 0; b <= d; ++b) {
        write_rows<T>(sums[b], task.sums[b] + c * particles + start, particles, count, rows.used);
      }
    }
  }
}

}  // namespace
