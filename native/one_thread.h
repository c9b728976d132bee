// Sums, transfers and decompositions as a GPU does them: what one thread does for a particle, or for a node. Plain C++
// that NVRTC compiles for a card, and g++ for the tests, which run one thread after the other.
//
// Terms are products of one polynomial along each axis. So a scatter takes what a particle gives one axis further in, to
// one node along it; a gather and a pull take the sums over the axes after an axis one step further out. All loops over
// axes, nodes and columns have constant bounds: unrolled, their arrays are registers.

#pragma once

#include "decompositions.h"
#include "step.h"

// Terms of the polynomials, a constant where a kernel is compiled for one basis.
#if !defined(MPMJAX_TERMS)
#define MPMJAX_TERMS basis.terms
#endif

namespace mpmjax {
namespace one_thread {

// As many columns of a node as are read or added at once: all, or where a kernel is for any number of them, 0, four.
constexpr int width_of(int columns) { return columns == 0 ? 4 : columns; }

// Columns of a node, which are read as a vector where they are a whole one.
template <class T, int c>
struct alignas(c * sizeof(T) % 16 == 0 ? 16 : c * sizeof(T) % 8 == 0 ? 8 : sizeof(T)) Row {
  T at[c];
};

// The first node of a particle along an axis, ⌊ξ − (s − 2)/2⌋, without meaning beyond 2³⁰. What is no number is on the
// window's first node, as XLA has it.
template <int s, class T>
int32_t first_of(T place) {
  constexpr T kFar = 1 << 30;
  const T low = place - T(s - 2) / 2, near = low > -kFar ? (low < kFar ? low : kFar) : low == low ? -kFar : 0;
  const int32_t whole = static_cast<int32_t>(near);
  return whole > near ? whole - 1 : whole;
}

template <class T>
void add(T* to, T number) {
#if defined(__CUDACC_RTC__)
  atomicAdd(to, number);
#else
  *to += number;
#endif
}

template <class T, int c>
void add_row(T* to, const Row<T, c>& row) {
#if defined(__CUDACC_RTC__) && __CUDA_ARCH__ >= 900
  if constexpr (c == 4 && sizeof(T) == 4) {
    atomicAdd(reinterpret_cast<float4*>(to), make_float4(row.at[0], row.at[1], row.at[2], row.at[3]));
    return;
  } else if constexpr (c == 2 && sizeof(T) == 4) {
    atomicAdd(reinterpret_cast<float2*>(to), make_float2(row.at[0], row.at[1]));
    return;
  }
#endif
  MPMJAX_UNROLL for (int k = 0; k < c; ++k) add(to + k, row.at[k]);
}

// The nodes and the polynomials of a particle.
template <class T, int d, int s>
struct Particle {
  int64_t number;
  uint32_t index[d][s];  // the share of each axis in the flat index; sums wrap, as those of XLA do
  T weights[d][s], slopes[d][s];

  Particle(const Stencils<T>& from, int64_t p) : number(p) {
    const Basis<T>& basis = from.basis;
    MPMJAX_UNROLL for (int a = 0; a < d; ++a) {
      const int32_t first = first_of<s>(from.place[a * from.particles + p]), period = basis.shape[a];
      const int32_t rest = basis.periodic[a] ? first % period : 0, place = rest < 0 ? rest + period : rest;
      MPMJAX_UNROLL for (int i = 0; i < s; ++i) {
        const uint32_t beyond = basis.periodic[a] ? (place + i) % period - place : i;
        index[a][i] = (static_cast<uint32_t>(first) + beyond) * static_cast<uint32_t>(basis.strides[a]);
      }
    }
  }

  // The polynomials, with derivatives along some axes, a bit each, times dξ if there is one.
  void evaluate(const Stencils<T>& from, unsigned differentiated = 0) {
    MPMJAX_UNROLL for (int a = 0; a < d; ++a) {
      const int64_t at = a * from.particles + number;
      const bool slope = differentiated >> a & 1;
      const T t = offset(from, a), factor = slope && from.change != nullptr ? from.change[at] : T(1);
      polynomials(from.basis, from.basis.weights, t, slope, factor, weights[a]);
      polynomials(from.basis, from.basis.slopes, t, slope, factor, slopes[a]);
    }
  }

  T offset(const Stencils<T>& from, int a) const {
    const T place = from.place[a * from.particles + number];
    return place - first_of<s>(place) - T(s - 1) / 2;
  }

  // Σ_k c_k (t − τ)^k for each node, or the derivative Σ_k k c_k (t − τ)^(k−1), times a factor.
  static void polynomials(const Basis<T>& basis, const T (*c)[kMostTerms], T t, bool slope, T factor, T* to) {
    MPMJAX_UNROLL for (int i = 0; i < s; ++i) {
      const T x = t - basis.knots[i];
      T sum = 0;
      if (slope) {
        MPMJAX_UNROLL for (int k = MPMJAX_TERMS - 1; k >= 1; --k) sum = sum * x + k * c[i][k];
      } else {
        MPMJAX_UNROLL for (int k = MPMJAX_TERMS - 1; k >= 0; --k) sum = sum * x + c[i][k];
      }
      to[i] = sum * factor;
    }
  }
};

// Some columns of the nodes of an array (size, columns), from a first one on. Others than all of them may be fewer than
// are read or added at once.
template <class T, int columns, class X>
struct Nodes {
  static constexpr int c = width_of(columns);
  X* numbers;
  int64_t size, stride;
  int used;

  Nodes(X* all, int64_t size, int64_t stride, int64_t column)
      : numbers(all + column), size(size), stride(columns == 0 ? stride : columns),
        used(columns == 0 && stride - column < c ? static_cast<int>(stride - column) : c) {}

  // An index beyond the window is clipped to its ends.
  Row<T, c> read(uint32_t node) const {
    const int64_t index = static_cast<int32_t>(node), last = size - 1;
    const X* from = numbers + (index < 0 ? 0 : index > last ? last : index) * stride;
    if constexpr (columns != 0) {
      return *reinterpret_cast<const Row<T, c>*>(from);
    } else {
      Row<T, c> row;
      MPMJAX_UNROLL for (int k = 0; k < c; ++k) row.at[k] = k < used ? from[k] : T(0);
      return row;
    }
  }

  // An index beyond the window is dropped.
  void give(uint32_t node, const Row<T, c>& row) const {
    const int64_t index = static_cast<int32_t>(node);
    if (index < 0 || index >= size) return;
    if constexpr (columns != 0) {
      add_row(numbers + index * stride, row);
    } else {
      MPMJAX_UNROLL for (int k = 0; k < c; ++k) {
        if (k < used) add(numbers + index * stride + k, row.at[k]);
      }
    }
  }
};

// What a particle gives: the value and each gradient.
template <class T, int d, int c>
struct Given {
  Row<T, c> at[d + 1] = {};

  Given() = default;
  Given(const ParticleValues<T>& values, int64_t p, int64_t particles, int64_t column, int64_t columns) {
    MPMJAX_UNROLL for (int k = 0; k < c; ++k) {
      const int64_t m = column + k;
      at[0].at[k] = values.value != nullptr && m < columns ? values.value[m * particles + p] : T(0);
      MPMJAX_UNROLL for (int b = 0; b < d; ++b) {
        const bool some = values.gradients != nullptr && m < values.graded;
        at[b + 1].at[k] = some ? values.gradients[(b * values.graded + m) * particles + p] : T(0);
      }
    }
  }
};

// Gives to all nodes that follow from one of the axes before a: the value, and the gradients along the axes from a on.
template <int a, class T, int d, int s, int c, class To>
void spread(const Particle<T, d, s>& at, uint32_t node, const Row<T, c>* given, const To& to) {
  if constexpr (a == d) {
    to.give(node, given[0]);
  } else {
    MPMJAX_UNROLL for (int i = 0; i < s; ++i) {
      const T w = at.weights[a][i], g = at.slopes[a][i];
      Row<T, c> inner[d - a];
      MPMJAX_UNROLL for (int k = 0; k < c; ++k) {
        inner[0].at[k] = w * given[0].at[k] + g * given[1].at[k];
        MPMJAX_UNROLL for (int b = 1; b < d - a; ++b) inner[b].at[k] = w * given[b + 1].at[k];
      }
      spread<a + 1>(at, node + at.index[a][i], inner, to);
    }
  }
}

// The sums of a gather over the axes from a on: the value, and the gradients along these axes.
template <class T, int d, int c, int a>
struct Gathered {
  Row<T, c> value = {}, gradients[d - a + 1] = {};

  void add(T w, T g, const Gathered<T, d, c, a + 1>& inner) {
    MPMJAX_UNROLL for (int k = 0; k < c; ++k) {
      value.at[k] += w * inner.value.at[k];
      gradients[0].at[k] += g * inner.value.at[k];
      MPMJAX_UNROLL for (int b = 1; b < d - a; ++b) gradients[b].at[k] += w * inner.gradients[b - 1].at[k];
    }
  }
};

template <int a, class T, int d, int s, class From>
Gathered<T, d, From::c, a> collect(const Particle<T, d, s>& at, uint32_t node, const From& from) {
  Gathered<T, d, From::c, a> sums;
  if constexpr (a == d) {
    sums.value = from.read(node);
  } else {
    MPMJAX_UNROLL for (int i = 0; i < s; ++i) {
      sums.add(at.weights[a][i], at.slopes[a][i], collect<a + 1>(at, node + at.index[a][i], from));
    }
  }
  return sums;
}

// The sums of a pull over the axes from a on, without a derivative and by ξ along each of these axes: one of
// f · a and the gradients along these axes, and one of f · a_b for each axis before them.
template <class T, int d, int a>
struct Pulled {
  T by[d - a + 1][a + 1] = {};
};

template <int a, class T, int d, int s, int c, class From>
Pulled<T, d, a> pull_from(const Particle<T, d, s>& at, const Particle<T, d, s>& slope, uint32_t node,
                          const Given<T, d, c>& given, const From& from) {
  Pulled<T, d, a> sums;
  if constexpr (a == d) {
    const Row<T, c> f = from.read(node);
    MPMJAX_UNROLL for (int b = 0; b <= d; ++b) {
      MPMJAX_UNROLL for (int k = 0; k < c; ++k) sums.by[0][b] += given.at[b].at[k] * f.at[k];
    }
  } else {
    const auto join = [](T w, T g, const T* inner, T* to) {
      to[0] += w * inner[0] + g * inner[a + 1];
      MPMJAX_UNROLL for (int b = 1; b <= a; ++b) to[b] += w * inner[b];
    };
    MPMJAX_UNROLL for (int i = 0; i < s; ++i) {
      const Pulled<T, d, a + 1> inner = pull_from<a + 1>(at, slope, node + at.index[a][i], given, from);
      join(at.weights[a][i], at.slopes[a][i], inner.by[0], sums.by[0]);
      join(slope.weights[a][i], slope.slopes[a][i], inner.by[0], sums.by[1]);
      MPMJAX_UNROLL for (int m = 1; m < d - a; ++m) {
        join(at.weights[a][i], at.slopes[a][i], inner.by[m], sums.by[m + 1]);
      }
    }
  }
  return sums;
}

// A differential along dξ is a sum over the axes, of the same sums with derivatives along one of them.
template <class T, int d, class Run>
void over_passes(const Stencils<T>& stencils, const Run& run) {
  if (stencils.change == nullptr) return run(0u, 0);
  for (int pass = 0; pass < d; ++pass) run(1u << pass, pass);
}

template <int d, int s, int columns, class T>
void run(const Scatter<T>& all, int64_t p) {
  constexpr int c = width_of(columns);
  Particle<T, d, s> at(all.stencils, p);
  over_passes<T, d>(all.stencils, [&](unsigned differentiated, int) {
    at.evaluate(all.stencils, differentiated);
    for (int64_t column = 0; column < (columns == 0 ? all.columns : 1); column += c) {
      const Given<T, d, c> given(all.values, p, all.stencils.particles, column, all.columns);
      spread<0>(at, 0, given.at, Nodes<T, columns, T>(all.nodes, all.size, all.columns, column));
    }
  });
}

template <int d, int s, int columns, class T>
void run(const Gather<T>& all, int64_t p) {
  constexpr int c = width_of(columns);
  const int64_t particles = all.stencils.particles;
  Particle<T, d, s> at(all.stencils, p);
  over_passes<T, d>(all.stencils, [&](unsigned differentiated, int pass) {
    at.evaluate(all.stencils, differentiated);
    for (int64_t column = 0; column < (columns == 0 ? all.columns : 1); column += c) {
      const Nodes<T, columns, const T> nodes(all.nodes, all.size, all.columns, column);
      const auto sums = collect<0>(at, 0, nodes);
      const auto put = [&](T* to, int64_t row, T number) {
        T& place = to[row * particles + p];
        place = pass > 0 ? place + number : number;
      };
      MPMJAX_UNROLL for (int k = 0; k < c; ++k) {
        if (k >= nodes.used) continue;
        put(all.value, column + k, sums.value.at[k]);
        MPMJAX_UNROLL for (int b = 0; b < d; ++b) {
          put(all.gradients, b * all.columns + column + k, sums.gradients[b].at[k]);
        }
      }
    }
  });
}

template <int d, int s, int columns, class T>
void run(const Pull<T>& all, int64_t p) {
  constexpr int c = width_of(columns);
  Particle<T, d, s> at(all.stencils, p), slope = at;
  at.evaluate(all.stencils);
  slope.evaluate(all.stencils, ~0u);
  T total[d] = {};
  for (int64_t column = 0; column < (columns == 0 ? all.columns : 1); column += c) {
    const Given<T, d, c> given(all.values, p, all.stencils.particles, column, all.columns);
    const Nodes<T, columns, const T> nodes(all.nodes, all.size, all.columns, column);
    const auto sums = pull_from<0>(at, slope, 0, given, nodes);
    MPMJAX_UNROLL for (int b = 0; b < d; ++b) total[b] += sums.by[b + 1][0];
  }
  MPMJAX_UNROLL for (int b = 0; b < d; ++b) all.by_place[b * all.stencils.particles + p] = total[b];
}

// r_p = K_p G_p of the gradients G_p of what is gathered, and their scatter.
template <int d, int s, int, class T>
void run(const Resist<T>& all, int64_t p) {
  const int64_t particles = all.stencils.particles;
  Particle<T, d, s> at(all.stencils, p);
  at.evaluate(all.stencils);
  const auto sums = collect<0>(at, 0, Nodes<T, d, const T>(all.moved, all.size, d, 0));
  Given<T, d, d> given;
  const T* from = all.matrices + p;
  MPMJAX_UNROLL for (int i = 0; i < d * d; ++i) {
    MPMJAX_UNROLL for (int j = i; j < d * d; ++j, from += particles) {
      const T entry = *from;
      given.at[1 + i / d].at[i % d] += entry * sums.gradients[j / d].at[j % d];
      if (j > i) given.at[1 + j / d].at[j % d] += entry * sums.gradients[i / d].at[i % d];
    }
  }
  spread<0>(at, 0, given.at, Nodes<T, d, T>(all.nodes, all.size, d, 0));
}

// Arrays (..., p) at one particle.
template <class T>
struct Lane {
  using V = T;
  int64_t p, particles;

  T load(const T* array, int row) const { return array[row * particles + p]; }
  void store(T* array, int row, T number) const { array[row * particles + p] = number; }
};

template <int d, int s, int, class T>
void run(const P2G<T>& all, int64_t p) {
  const Lane<T> lane = {p, all.stencils.particles};
  Particle<T, d, s> at(all.stencils, p);
  at.evaluate(all.stencils);
  Given<T, d, d + 1> given;
  put_rows<d, s, T>(
      all, [&](int b) { return at.offset(all.stencils, b); },
      [&](const T* array, int row) { return lane.load(array, row); },
      [&](int row, const T* numbers) {
        MPMJAX_UNROLL for (int k = 0; k <= d; ++k) given.at[row].at[k] = numbers[k];
      });
  spread<0>(at, 0, given.at, Nodes<T, d + 1, T>(all.sums, all.size, d + 1, 0));
}

template <int d, int s, int, class T>
void run(const G2P<T>& all, int64_t p) {
  const Lane<T> lane = {p, all.stencils.particles};
  Particle<T, d, s> at(all.stencils, p);
  at.evaluate(all.stencils);
  const auto sums = collect<0>(at, 0, Nodes<T, d, const T>(all.nodes, all.size, d, 0));
  const T* gradients[d];
  MPMJAX_UNROLL for (int b = 0; b < d; ++b) gradients[b] = sums.gradients[b].at;
  move<d>(
      all, sums.value.at, gradients, [&](const T* array, int row) { return lane.load(array, row); },
      [&](T* array, int row, T number) { lane.store(array, row, number); });
}

template <int, int, int, class T>
void run(const Eigen<T>& all, int64_t p) {
  decompose(all, Lane<T>{p, all.particles});
}
template <int, int, int, class T>
void run(const Rotation<T>& all, int64_t p) {
  decompose(all, Lane<T>{p, all.particles});
}

// Of a node, once its sums are whole. Where the last column is not more than the least, all are zero.
template <int, int, int, class T>
void run(const Average<T>& all, int64_t i) {
  const int64_t others = all.columns - 1;
  const T* sums = all.sums + i * all.columns;
  const bool some = sums[others] > all.least[0];
  all.whole[i] = some ? sums[others] : T(0);
  for (int64_t k = 0; k < others; ++k) all.means[i * others + k] = some ? sums[k] / sums[others] : T(0);
}

}  // namespace one_thread
}  // namespace mpmjax
