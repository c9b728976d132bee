// The pull: the derivative of B = Σ_ip f_i · (w_ip a_p + Σ_b g_ip,b a_p,b) by the factors along each axis.
//
// By a factor along axis a, B is a product of what the axes before it and the last narrow and what those after it gather;
// by one along the last axis it is a product of what is given and what all other axes gather. The gather comes out beside
// it.

#pragma once

#include "gather.h"

namespace {

using mpmjax::Pull;

// A row for each factor of the axes but the last, whose sum is the derivative by it.
template <class R, int d>
struct Slopes {
  R by_weights[d][R::s];
  R by_derivatives[d][R::s];
};

template <class T, int d, int s, bool inside, int columns>
struct Puller {
  const Block<T, d, s, false>& block;
  const NodeRows<T, s, columns>& rows;
  int q;

  static constexpr int last = d - 1;
  using R = RowOf<T, s, columns>;

  // Adds the derivatives by the factors of the axes from a on but the last, and returns the sums over these axes.
  template <int a>
  MPMJAX_INLINE Sums<R, last - a> pull(int32_t first, R value, const R* gradients, Slopes<R, d>& slopes) const {
    Sums<R, last - a> total = {};
    if constexpr (a == last) {
      total.value = rows.template only<inside>(block, q, first);
    } else {
      each<s, inside && a + 1 >= last>([&](int i) MPMJAX_INLINE_LAMBDA {
        const T w = block.weights[a][i][q], g = block.derivatives[a][i][q];
        R inner[d - a];
        for (int b = 1; b < last - a; ++b) inner[b - 1] = product(w, gradients[b]);
        const R narrow = product(w, value) + product(g, gradients[0]);
        const auto found = pull<a + 1>(after(first, block.index[a][i][q]), narrow, inner, slopes);
        R by_weight = product(value, found.value);
        for (int b = 1; b < last - a; ++b) by_weight = by_weight + product(gradients[b], found.gradients[b - 1]);
        slopes.by_weights[a][i] = slopes.by_weights[a][i] + by_weight;
        slopes.by_derivatives[a][i] = slopes.by_derivatives[a][i] + product(gradients[0], found.value);
        total.value = total.value + product(w, found.value);
        total.gradients[0] = total.gradients[0] + product(g, found.value);
        for (int b = 1; b < last - a; ++b) {
          total.gradients[b] = total.gradients[b] + product(w, found.gradients[b - 1]);
        }
      });
    }
    return total;
  }

  // The derivatives by all factors, of the particle's rows of four: add(a, i, by the weight, by the derivative), each as
  // four lanes to be summed.
  template <class Add>
  MPMJAX_INLINE void all(const Vector<T> (*given)[kRoom], const Add& add) const {
    const R w = block.template last_weight<R>(q), g = block.template last_derivative<R>(q);
    const R value = at_each<R, T>(given[0][q]), along = at_each<R, T>(given[d][q]);
    R gradients[d], narrow[d];
    for (int b = 0; b < last; ++b) gradients[b] = at_each<R, T>(given[b + 1][q]), narrow[b] = product(w, gradients[b]);
    Slopes<R, d> slopes = {};
    const auto found = pull<0>(0, product(w, value) + product(g, along), narrow, slopes);
    for (int a = 0; a < last; ++a) {
      for (int i = 0; i < s; ++i) add(a, i, sum(slopes.by_weights[a][i]), sum(slopes.by_derivatives[a][i]));
    }
    R by_weight = product(value, found.value);
    for (int b = 0; b < last; ++b) by_weight = by_weight + product(gradients[b], found.gradients[b]);
    const R by_derivative = product(along, found.value);
    each<s, true>([&](auto i) MPMJAX_INLINE_LAMBDA {
      constexpr int node = decltype(i)::value;
      add(last, node, columns_at<node>(by_weight), columns_at<node>(by_derivative));
    });
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

// A block's particles abreast.
template <class T, int d, int s, int columns>
MPMJAX_INLINE void pull_fields(const Pull<T>& task, const Block<T, d, s, false>& block, int64_t start) {
  using Some = Fields<T, d, s, columns>;
  using V = Abreast<T>;
  const int64_t particles = task.stencils.particles;
  for (int q = 0; q < kBlock; q += kAbreast<T>) {
    const int64_t first = start + q;
    V given[d + 1][columns] = {};
    for (int c = 0; c < columns; ++c) {
      if (task.given.value != nullptr) std::memcpy(&given[0][c], task.given.value + c * particles + first, sizeof(V));
      for (int b = 0; b < d && c < task.given.graded; ++b) {
        const int64_t row = b * task.given.graded + c;
        std::memcpy(&given[b + 1][c], task.given.gradients + row * particles + first, sizeof(V));
      }
    }
    Some some(block, q, task.nodes, task.size);
    some.read_all();
    const auto found = some.pull(given);
    for (int a = 0; a < d; ++a) {
      for (int i = 0; i < s; ++i) {
        const int64_t at = (a * s + i) * particles + first;
        Some::put(task.given.value == nullptr && d == 1 ? V{} : some.by_weights[a][i], task.by_weights + at);
        Some::put(task.given.gradients == nullptr ? V{} : some.by_derivatives[a][i], task.by_derivatives + at);
      }
    }
    if (task.value != nullptr) some.write_sums(found, particles, task.value + first, task.gradients + first);
  }
}

template <class T, int d, int s, int columns>
void pull_columns(const Pull<T>& task, int64_t first, int64_t last) {
  const int64_t particles = task.stencils.particles;
  for (int64_t start = first; start < last; start += kBlock) {
    const int count = smaller(last - start, kBlock);
    Block<T, d, s, false> block;
    block.find_range(task.stencils, start, count);
    block.read(task.stencils, start, count);
    if constexpr (columns > 0) {
      if (has_fields<T, d, s, columns>(block, task.size)) {
        pull_fields<T, d, s, columns>(task, block, start);
        continue;
      }
    }
    block.join_last();
    Vector<T> by_weights[d][s][kBlock], by_derivatives[d][s][kBlock];
    for (int64_t c = 0; c < (columns == 0 ? task.columns : columns); c += kLanes) {
      const NodeRows<T, s, columns> rows(task.nodes, task.size, task.columns, c);
      const Present<Row<T, 1, kLanes, 1>> present(rows.used);
      Vector<T> given[d + 1][kRoom];
      read_given<T, d, true>(task.given, particles, c, rows.used, start, count, given);
      for (int q = 0; q < kBlock; ++q) {
        const auto add = [&](int a, int i, Vector<T> by_weight, Vector<T> by_derivative) MPMJAX_INLINE_LAMBDA {
          const auto put = [&](Vector<T>& to, Vector<T> found) MPMJAX_INLINE_LAMBDA {
            if constexpr (columns != kLanes) found = present.of({{found}}).parts[0];
            to = c == 0 ? found : to + found;
          };
          put(by_weights[a][i][q], by_weight);
          put(by_derivatives[a][i][q], by_derivative);
        };
        if (rows.holds(block, q)) {
          Puller<T, d, s, true, columns>{block, rows, q}.all(given, add);
        } else {
          Puller<T, d, s, false, columns>{block, rows, q}.all(given, add);
        }
      }
      if (task.value != nullptr) {
        const int64_t at = c * particles + start;
        gather_rows(block, rows, particles, task.columns, count, task.value + at, task.gradients + at);
      }
    }
    // What has no part in B is zero, also where it would be zero times what is not finite.
    if (task.given.gradients == nullptr) std::memset(by_derivatives, 0, sizeof by_derivatives);
    if (task.given.value == nullptr && d == 1) std::memset(by_weights, 0, sizeof by_weights);
    for (int a = 0; a < d; ++a) {
      for (int i = 0; i < s; ++i) {
        const int64_t at = (a * s + i) * particles + start;
        add_lanes<T>(by_weights[a][i], count, task.by_weights + at);
        add_lanes<T>(by_derivatives[a][i], count, task.by_derivatives + at);
      }
    }
  }
}

template <class T, int d, int s>
void pull(const Pull<T>& task, int64_t first, int64_t last) {
  switch (task.columns) {
    case 1: return pull_columns<T, d, s, 1>(task, first, last);
    case 2: return pull_columns<T, d, s, 2>(task, first, last);
    case 3: return pull_columns<T, d, s, 3>(task, first, last);
    case 4: return pull_columns<T, d, s, 4>(task, first, last);
    default: return pull_columns<T, d, s, 0>(task, first, last);
  }
}

}  // namespace
