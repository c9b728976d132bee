// Fields: what the nodes of some particles' stencils have, with a particle in each lane.
//
// Rows of nodes are read as they lie and turned, four numbers of four particles at a time. Sums over the nodes are then
// sums of vectors, and what particles have is read and written as it lies.

#pragma once

#include "abreast.h"
#include "block.h"

namespace {

constexpr int power(int base, int exponent) { return exponent == 0 ? 1 : base * power(base, exponent - 1); }

// The nodes along the last axis, with all their columns.
template <class T, int s, int columns>
struct Field {
  using V = Abreast<T>;
  static constexpr int numbers = s * columns;
  static constexpr int reach = (numbers + kLanes - 1) / kLanes * kLanes;  // how many are read at once
  V at[numbers];

  template <class F>
  static MPMJAX_INLINE Field of(const F& number) {
    Field field;
#pragma GCC unroll 16
    for (int k = 0; k < numbers; ++k) field.at[k] = number(k);
    return field;
  }
};

template <class T, int s, int c>
MPMJAX_INLINE Field<T, s, c> product(Abreast<T> a, const Field<T, s, c>& x) {
  return Field<T, s, c>::of([&](int k) MPMJAX_INLINE_LAMBDA { return a * x.at[k]; });
}

template <class T, int s, int c>
MPMJAX_INLINE Field<T, s, c> operator+(const Field<T, s, c>& a, const Field<T, s, c>& b) {
  return Field<T, s, c>::of([&](int k) MPMJAX_INLINE_LAMBDA { return a.at[k] + b.at[k]; });
}

// The sum of the products of all numbers.
template <class T, int s, int c>
MPMJAX_INLINE Abreast<T> dot(const Field<T, s, c>& a, const Field<T, s, c>& b) {
  Abreast<T> total = a.at[0] * b.at[0];
#pragma GCC unroll 16
  for (int k = 1; k < s * c; ++k) total += a.at[k] * b.at[k];
  return total;
}

// Whether the nodes of all particles of a block can be read as fields.
template <class T, int d, int s, int columns>
MPMJAX_INLINE bool has_fields(const Block<T, d, s, false>& block, int64_t size) {
  if constexpr (columns == 0 || kAbreast<T> < kLanes) return false;
  const int64_t most = (size * columns - Field<T, s, columns>::reach) / columns + s - 1;
  bool all = size * columns >= Field<T, s, columns>::reach;
  for (int q = 0; q < kBlock; ++q) {
    all &= block.straight[q] && block.least[q] >= 0 && block.most[q] < size && block.most[q] <= most;
  }
  return all;
}

// The fields that some particles of a block read, from the q-th on, and the sums over them.
template <class T, int d, int s, int columns>
struct Fields {
  using V = Abreast<T>;
  using F = Field<T, s, columns>;
  static constexpr int last = d - 1, rows = power(s, last), lanes = kAbreast<T>;

  V weights[d][s], derivatives[d][s];
  F nodes[rows];  // in C order of the axes before the last

  MPMJAX_INLINE Fields(const Block<T, d, s, false>& block, int q, const T* from) {
    for (int a = 0; a < d; ++a) {
      for (int i = 0; i < s; ++i) {
        std::memcpy(&weights[a][i], block.weights[a][i] + q, sizeof(V));
        std::memcpy(&derivatives[a][i], block.derivatives[a][i] + q, sizeof(V));
      }
    }
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

  V by_weights[d][s], by_derivatives[d][s];  // of a pull

  // Returns the sums over the axes from a on but the last, from the nodes of a first row on, and with `pulled` adds the
  // derivatives by these axes' factors.
  template <int a, bool pulled>
  MPMJAX_INLINE Sums<a> sums(const F* from, const F& value, const F* gradients) {
    Sums<a> total = {};
    if constexpr (a == last) {
      total.value = *from;
    } else {
      for (int i = 0; i < s; ++i) {
        const V w = weights[a][i], g = derivatives[a][i];
        F narrow, inner[d];
        if constexpr (pulled && a + 1 < last) {
          narrow = product(w, value) + product(g, gradients[0]);
          for (int b = 1; b < last - a; ++b) inner[b - 1] = product(w, gradients[b]);
        }
        const auto found = sums<a + 1, pulled>(from + i * power(s, last - a - 1), narrow, inner);
        if constexpr (pulled) {
          V by_weight = dot(value, found.value);
          for (int b = 1; b < last - a; ++b) by_weight += dot(gradients[b], found.gradients[b - 1]);
          by_weights[a][i] += by_weight;
          by_derivatives[a][i] += dot(gradients[0], found.value);
        }
        total.value = total.value + product(w, found.value);
        total.gradients[0] = total.gradients[0] + product(g, found.value);
        for (int b = 1; b < last - a; ++b) {
          total.gradients[b] = total.gradients[b] + product(w, found.gradients[b - 1]);
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
  MPMJAX_INLINE void write_sums(const Sums<0>& found, int64_t particles, T* value, T* gradients) const {
    for (int c = 0; c < columns; ++c) {
      put(along(weights[last], found.value, c), value + c * particles);
      for (int b = 0; b < last; ++b) {
        put(along(weights[last], found.gradients[b], c), gradients + (b * columns + c) * particles);
      }
      put(along(derivatives[last], found.value, c), gradients + (last * columns + c) * particles);
    }
  }

  MPMJAX_INLINE Sums<0> gather() {
    F none;
    return sums<0, false>(nodes, none, nullptr);
  }

  // The same, and the derivatives by all factors, of all columns of the value and the gradients that are given.
  MPMJAX_INLINE Sums<0> pull(const V (*given)[columns]) {
    const V *w = weights[last], *g = derivatives[last];
    const auto spread = [&](const V* of, const V* factors) MPMJAX_INLINE_LAMBDA {
      return F::of([&](int k) MPMJAX_INLINE_LAMBDA { return factors[k / columns] * of[k % columns]; });
    };
    F gradients[d];
    for (int b = 0; b < last; ++b) gradients[b] = spread(given[b + 1], w);
    std::memset(by_weights, 0, sizeof by_weights);
    std::memset(by_derivatives, 0, sizeof by_derivatives);
    const auto found = sums<0, true>(nodes, spread(given[0], w) + spread(given[d], g), gradients);
    for (int j = 0; j < s; ++j) {
      for (int c = 0; c < columns; ++c) {
        by_weights[last][j] += given[0][c] * found.value.at[j * columns + c];
        by_derivatives[last][j] += given[d][c] * found.value.at[j * columns + c];
        for (int b = 0; b < last; ++b) by_weights[last][j] += given[b + 1][c] * found.gradients[b].at[j * columns + c];
      }
    }
    return found;
  }

  static MPMJAX_INLINE void put(V v, T* to) { std::memcpy(to, &v, sizeof v); }
};

}  // namespace
