// Fields: what the nodes of some particles' stencils have, with a particle in each lane.
//
// Rows of nodes are read by runs where there are few. Else they are read as they lie and turned, four numbers of four
// particles at a time. Sums over the nodes are then sums of vectors, and what particles have is read and written as it
// lies.

#pragma once

#include "runs.h"

namespace {

template <class T, int s, int c>
MPMJAX_INLINE Field<T, s, c> product(Simd<T> a, const Field<T, s, c>& x) {
  return Field<T, s, c>::of([&](int k) MPMJAX_INLINE_LAMBDA { return a * x.at[k]; });
}

template <class T, int s, int c>
MPMJAX_INLINE Field<T, s, c> operator+(const Field<T, s, c>& a, const Field<T, s, c>& b) {
  return Field<T, s, c>::of([&](int k) MPMJAX_INLINE_LAMBDA { return a.at[k] + b.at[k]; });
}

// The sum of the products of all numbers.
template <class T, int s, int c>
MPMJAX_INLINE Simd<T> dot(const Field<T, s, c>& a, const Field<T, s, c>& b) {
  Simd<T> total = a.at[0] * b.at[0];
#pragma GCC unroll 16
  for (int k = 1; k < s * c; ++k) total += a.at[k] * b.at[k];
  return total;
}

// Whether the nodes of all particles of a block can be read as fields.
template <class T, int d, int s, int columns>
MPMJAX_INLINE bool has_fields(const Block<T, d, s>& block, int64_t size) {
  if constexpr (columns == 0 || kSimdLanes<T> < kLanes) return false;
  const int64_t most = (size * columns - Field<T, s, columns>::reach) / columns + s - 1;
  bool all = size * columns >= Field<T, s, columns>::reach;
  for (int q = 0; q < kBlock; ++q) {
    all &= block.contiguous[q] && block.least[q] >= 0 && block.most[q] < size && block.most[q] <= most;
  }
  return all;
}

// The gathered value and gradients of all columns of some particles, one in each lane.
template <class T, int d, int columns>
struct Gathered {
  using V = Simd<T>;
  V value[columns] = {}, gradients[d][columns] = {};

  // Adds what one node along axis a has, times its factors: its value, and its gradients along the axes after it.
  template <int a>
  MPMJAX_INLINE void add(V w, V g, const Gathered& inner) {
#pragma GCC unroll 4
    for (int c = 0; c < columns; ++c) {
      value[c] += w * inner.value[c];
      gradients[a][c] += g * inner.value[c];
#pragma GCC unroll 2
      for (int b = a + 1; b < d; ++b) gradients[b][c] += w * inner.gradients[b][c];
    }
  }
};

// The fields that some particles of a block read, from the q-th on, and the sums over them.
template <class T, int d, int s, int columns>
struct Fields {
  using V = Simd<T>;
  using F = Field<T, s, columns>;
  static constexpr int last = d - 1, rows = power(s, last), lanes = kSimdLanes<T>;

  const Block<T, d, s>& block;
  int q;
  const T* from;
  V weights[d][s], slopes[d][s];
  Runs<T, d, s, columns> runs;
  bool joined = false;  // whether rows are read by runs
  F nodes[rows];        // in C order of the axes before the last; none before `read_all` if rows are read by runs

  MPMJAX_INLINE Fields(const Block<T, d, s>& block, int q, const T* from, int64_t size)
      : block(block), q(q), from(from) {
    for (int a = 0; a < d; ++a) {
      for (int i = 0; i < s; ++i) {
        weights[a][i] = at(block.weights[a][i]), slopes[a][i] = at(block.slopes[a][i]);
      }
    }
    if constexpr (kPermutes<T>) joined = runs.find(block, q, size);
    if (!joined) read_each();
  }

  // Reads all rows, for sums that need them more than once.
  MPMJAX_INLINE void read_all() {
    if constexpr (kPermutes<T>) {
      for (int row = 0; row < rows && joined; ++row) nodes[row] = runs.row(block, q, from, row);
    }
  }

  // The same without runs.
  MPMJAX_INLINE void read_each() {
    for (int row = 0; row < rows; ++row) {
      T* to = reinterpret_cast<T*>(&nodes[row]);
      for (int p = 0; p < lanes; p += kLanes) {
        const T* places[kLanes];
        for (int e = 0; e < kLanes; ++e) {
          int64_t index = block.index[last][0][q + p + e];
          if constexpr (d == 2) index += block.index[0][row][q + p + e];
          if constexpr (d == 3) index += block.index[0][row / s][q + p + e] + block.index[1][row % s][q + p + e];
          places[e] = from + index * columns;
        }
#pragma GCC unroll 4
        for (int k = 0; k < F::numbers; k += kLanes) {
          Vector<T> read[kLanes], turned[kLanes];
          for (int e = 0; e < kLanes; ++e) read[e] = load(places[e] + k);
          transpose<T>(read, turned);
          for (int e = 0; e < kLanes && k + e < F::numbers; ++e) store(to + (k + e) * lanes + p, turned[e]);
        }
      }
    }
  }

  // The sums over the axes from a on but the last: the value, and a gradient for each of these axes.
  template <int a>
  struct Sums {
    F value;
    F gradients[last - a == 0 ? 1 : last - a];
  };

  V by_weights[d][s], by_slopes[d][s];  // of a pull

  // Returns the sums over the axes from a on but the last, from the nodes of a first row on, and adds the derivatives by
  // the offsets along these axes.
  template <int a>
  MPMJAX_INLINE Sums<a> sums(const F* from, const F& value, const F* gradients, const Block<T, d, s>& derivatives,
                             V* by_offset) const {
    Sums<a> total = {};
    if constexpr (a == last) {
      total.value = *from;
    } else {
      for (int i = 0; i < s; ++i) {
        const V w = weights[a][i], g = slopes[a][i];
        F narrow, inner[d];
        if constexpr (a + 1 < last) {
          narrow = product(w, value) + product(g, gradients[0]);
          for (int b = 1; b < last - a; ++b) inner[b - 1] = product(w, gradients[b]);
        }
        const auto result = sums<a + 1>(from + i * power(s, last - a - 1), narrow, inner, derivatives, by_offset);
        V by_weight = dot(value, result.value);
        for (int b = 1; b < last - a; ++b) by_weight += dot(gradients[b], result.gradients[b - 1]);
        by_offset[a] += at(derivatives.weights[a][i]) * by_weight +
                        at(derivatives.slopes[a][i]) * dot(gradients[0], result.value);
        total.value = total.value + product(w, result.value);
        total.gradients[0] = total.gradients[0] + product(g, result.value);
        for (int b = 1; b < last - a; ++b) {
          total.gradients[b] = total.gradients[b] + product(w, result.gradients[b - 1]);
        }
      }
    }
    return total;
  }

  // Σ_j factors_j f_jc over the nodes along the last axis.
  static MPMJAX_INLINE V along(const V* factors, const F& field, int c) {
    V total = factors[0] * field.at[c];
    for (int j = 1; j < s; ++j) total += factors[j] * field.at[j * columns + c];
    return total;
  }

  // Writes the gathered value and gradients of all columns, as columns of (c, p) and (d, c, p).
  MPMJAX_INLINE void write_sums(const Sums<0>& result, int64_t particles, T* value, T* gradients) const {
    for (int c = 0; c < columns; ++c) {
      put(along(weights[last], result.value, c), value + c * particles);
      for (int b = 0; b < last; ++b) {
        put(along(weights[last], result.gradients[b], c), gradients + (b * columns + c) * particles);
      }
      put(along(slopes[last], result.value, c), gradients + (last * columns + c) * particles);
    }
  }

  // The sums over the axes from a on, of rows from a first one on, each read where it is wanted.
  template <int a, class Row>
  MPMJAX_INLINE Gathered<T, d, columns> gathered(int first, const Row& row) const {
    Gathered<T, d, columns> total;
    if constexpr (a == last) {
      const F field = row(first);
      for (int c = 0; c < columns; ++c) total.value[c] = along(weights[last], field, c);
      for (int c = 0; c < columns; ++c) total.gradients[last][c] = along(slopes[last], field, c);
    } else {
      each<s, (a + 1 >= last)>([&](int i) MPMJAX_INLINE_LAMBDA {
        total.template add<a>(weights[a][i], slopes[a][i], gathered<a + 1>(s * first + i, row));
      });
    }
    return total;
  }

  // The gather, of which no field but the one at hand is stored.
  MPMJAX_INLINE Gathered<T, d, columns> gather() const {
    if constexpr (kPermutes<T>) {
      if (joined) {
        return gathered<0>(0, [&](int i) MPMJAX_INLINE_LAMBDA { return runs.row(block, q, from, i); });
      }
    }
    return gathered<0>(0, [&](int i) MPMJAX_INLINE_LAMBDA { return nodes[i]; });
  }

  // The sums of a gather, and the derivatives by the offsets, of all columns of the value and the gradients that are given.
  MPMJAX_INLINE Sums<0> pull(const V (*values)[columns], const Block<T, d, s>& derivatives, V* by_offset) const {
    const V *w = weights[last], *g = slopes[last];
    const auto spread = [&](const V* of, const V* factors) MPMJAX_INLINE_LAMBDA {
      return F::of([&](int k) MPMJAX_INLINE_LAMBDA { return factors[k / columns] * of[k % columns]; });
    };
    F gradients[d];
    for (int b = 0; b < last; ++b) gradients[b] = spread(values[b + 1], w);
    for (int a = 0; a < d; ++a) by_offset[a] = V{};
    const auto result = sums<0>(nodes, spread(values[0], w) + spread(values[d], g), gradients, derivatives, by_offset);
    for (int j = 0; j < s; ++j) {
      V by_weight = {}, by_slope = {};
      for (int c = 0; c < columns; ++c) {
        by_weight += values[0][c] * result.value.at[j * columns + c];
        by_slope += values[d][c] * result.value.at[j * columns + c];
        for (int b = 0; b < last; ++b) by_weight += values[b + 1][c] * result.gradients[b].at[j * columns + c];
      }
      by_offset[last] += at(derivatives.weights[last][j]) * by_weight + at(derivatives.slopes[last][j]) * by_slope;
    }
    return result;
  }

  // The numbers of these particles among those of a block.
  MPMJAX_INLINE V at(const T* numbers) const {
    V v;
    std::memcpy(&v, numbers + q, sizeof v);
    return v;
  }

  // Stores numbers, or adds them to what is there.
  static MPMJAX_INLINE void put(V v, T* to, bool add = false) {
    V before = {};
    if (add) std::memcpy(&before, to, sizeof v);
    v = add ? v + before : v;
    std::memcpy(to, &v, sizeof v);
  }
};

}  // namespace
