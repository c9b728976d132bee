// The gather, a_p = Σ_i w_ip f_i and a_p,b = Σ_i g_ip,b f_i, and the pull, the derivative of
// B = Σ_ip f_i · (w_ip a_p + Σ_b g_ip,b a_p,b) by ξ along each axis.
//
// There is a particle in each lane, so that sums over its nodes are sums of vectors, and what particles have is read
// and written as it lies. The nodes of a row are read once, by runs where there are few; else they are read particle by
// particle and transposed. Each axis then takes the sums over the axes after it one step further out.

#pragma once

#include "runs.h"
#include "step.h"

namespace {

using mpmjax::G2P;
using mpmjax::Gather;
using mpmjax::Pull;

// A gather. Its sums over the axes from a on: the value, and the gradients along these axes, of all columns.
template <class T, int d, int s, int columns>
struct GatherSums {
  using V = Simd<T>;
  static constexpr bool unrolled = true;

  template <int a>
  struct At {
    V value[columns] = {}, gradients[d - a + 1][columns] = {};

    // Adds the sums over the axes after a, of the i-th node along it.
    template <class Nodes>
    MPMJAX_INLINE void add(const Nodes& nodes, int i, const At<a + 1>& inner) {
      const V w = nodes.at(nodes.block.weights[a][i]), g = nodes.at(nodes.block.slopes[a][i]);
#pragma GCC unroll 4
      for (int c = 0; c < columns; ++c) {
        value[c] += w * inner.value[c];
        gradients[0][c] += g * inner.value[c];
#pragma GCC unroll 2
        for (int b = 1; b < d - a; ++b) gradients[b][c] += w * inner.gradients[b - 1][c];
      }
    }
  };

  // The sums over no axis: the j-th node of a row.
  static MPMJAX_INLINE At<d> node(const NodeRow<T, s, columns>& row, int j) {
    At<d> result;
#pragma GCC unroll 4
    for (int c = 0; c < columns; ++c) result.value[c] = row.at[j * columns + c];
    return result;
  }
};

// What a vector of particles gives: the value and each gradient, zero where there are none.
template <class T, int d, int columns>
struct GivenValues {
  Simd<T> at[d + 1][columns] = {};
  int used;

  MPMJAX_INLINE GivenValues(const ParticleLanes<T>& lanes, const Pull<T>& task, int64_t column, int used)
      : used(used) {
    const auto& values = task.values;
    by_lanes(lanes, [&](auto all) MPMJAX_INLINE_LAMBDA {
      for (int c = 0; c < used; ++c) {
        if (values.value != nullptr) at[0][c] = lanes.template load<all>(values.value, column + c);
        for (int b = 0; b < d && column + c < values.graded; ++b) {
          at[b + 1][c] = lanes.template load<all>(values.gradients, b * values.graded + column + c);
        }
      }
    });
  }
};

// A pull, and the gather beside it. B is linear in the numbers f · a and f · a_b of each node. Its sums over the axes
// from a on: without a derivative, and by ξ along each of these axes, one of f · a and the gradients along
// these axes, and one of f · a_b for each axis before them.
template <class T, int d, int s, int columns>
struct PullSums {
  using V = Simd<T>;
  using Given = GivenValues<T, d, columns>;
  static constexpr bool unrolled = d < 3;  // else the code doubles

  template <int a>
  struct At {
    typename GatherSums<T, d, s, columns>::template At<a> gathered;
    V by[d - a + 1][a + 1] = {};

    template <class Nodes>
    MPMJAX_INLINE void add(const Nodes& nodes, int i, const At<a + 1>& inner) {
      gathered.add(nodes, i, inner.gathered);
      const V w = nodes.at(nodes.block.weights[a][i]), g = nodes.at(nodes.block.slopes[a][i]);
      const auto join = [](V w, V g, const V* from, V* to) MPMJAX_INLINE_LAMBDA {
        to[0] += w * from[0] + g * from[a + 1];
#pragma GCC unroll 2
        for (int b = 1; b <= a; ++b) to[b] += w * from[b];
      };
      join(w, g, inner.by[0], by[0]);
      join(nodes.at(nodes.derivatives->weights[a][i]), nodes.at(nodes.derivatives->slopes[a][i]), inner.by[0], by[1]);
#pragma GCC unroll 2
      for (int m = 1; m < d - a; ++m) join(w, g, inner.by[m], by[m + 1]);
    }
  };

  static MPMJAX_INLINE At<d> node(const NodeRow<T, s, columns>& row, int j, const Given& given) {
    At<d> result;
    result.gathered = GatherSums<T, d, s, columns>::node(row, j);
#pragma GCC unroll 4
    for (int b = 0; b <= d; ++b) {
#pragma GCC unroll 4
      for (int c = 0; c < columns; ++c) {
        if (c < given.used) result.by[0][b] += given.at[b][c] * row.at[j * columns + c];
      }
    }
    return result;
  }
};

// The nodes of a vector of particles, from the q-th of a block on: all columns, or where `columns_` is 0 up to four
// from a first one. An index beyond the window is clipped to its ends, as in XLA's gather with mode "clip".
template <class T, int d, int s, int columns_>
struct Nodes {
  static constexpr int columns = columns_ == 0 ? kLanes : columns_;
  static constexpr int rows = power(s, d - 1), lanes = kSimdLanes<T>;
  static constexpr int numbers = (s * columns + kLanes - 1) / kLanes * kLanes;  // of a row, in whole fours
  static constexpr bool permutes = kPermutes<T> && columns_ > 0;
  using Row = NodeRow<T, s, columns>;
  using Index = LanesOf<float, lanes>;

  const Block<T, d, s>& block;
  const Block<T, d, s>* derivatives;  // of the polynomials, for a pull
  int q;
  const T* from;  // at the first of the columns
  int64_t size, stride;
  int used;
  int32_t most;  // the last node of a row that can be read in whole fours, which reach beyond it, or -1
  Runs<T, d, s, columns> runs;
  bool joined = false;  // whether rows are read by runs
  Row stored[rows];     // if they are not, or for a pull, in C order of the axes before the last

  MPMJAX_INLINE Nodes(const Block<T, d, s>& block, int q, const T* whole, int64_t size, int64_t all, int64_t column,
                      const Block<T, d, s>* derivatives = nullptr)
      : block(block), derivatives(derivatives), q(q), from(whole + column), size(size),
        stride(columns_ == 0 ? all : columns_), used(columns_ == 0 ? smaller(all - column, kLanes) : columns_) {
    const int64_t extent = size * all - column, reach = columns_ == 0 ? (s - 1) * stride + kLanes : numbers;
    const int64_t last = std::min(size - 1, (extent - reach) / stride + s - 1);
    most = extent < reach ? -1 : smaller(last, INT32_MAX);
    const Index least = load_as<Index>(block.least + q), ends = load_as<Index>(block.most + q);
    const bool whole_rows = !any((load_as<Index>(block.contiguous + q) == 0) | (least < 0) | (ends > most));
    if constexpr (permutes) {
      joined = whole_rows && runs.find(block, q, size);
      for (int i = 0; joined && derivatives != nullptr && i < rows; ++i) stored[i] = runs.row(block, q, from, i);
    }
    if (!joined) whole_rows ? read<true>() : read<false>();
  }

  // Reads all rows, four numbers of four particles at a time. Those that cannot be read as a whole are copied before.
  template <bool whole_rows>
  MPMJAX_NOINLINE void read() {
    for (int row = 0; row < rows; ++row) {
      for (int p = 0; p < lanes; p += kLanes) {
        T copies[kLanes][numbers];
        const T* places[kLanes];
        int64_t steps[kLanes];
        for (int e = 0; e < kLanes; ++e) {
          const int k = q + p + e;
          const bool whole = whole_rows || (block.contiguous[k] && block.least[k] >= 0 && block.most[k] <= most);
          if (!whole) copy_row(row, k, copies[e]);
          places[e] = whole ? from + block.node(row, k) * stride : copies[e];
          steps[e] = whole && columns_ == 0 ? stride : kLanes;
        }
#pragma GCC unroll 4
        for (int k = 0; k < numbers; k += kLanes) {
          Vector<T> read[kLanes], turned[kLanes];
          for (int e = 0; e < kLanes; ++e) read[e] = load_as<Vector<T>>(places[e] + k / kLanes * steps[e]);
          to_rows(read, turned);
          for (int e = 0; e < kLanes && k + e < Row::numbers; ++e) {
            store(reinterpret_cast<T*>(&stored[row].at[k + e]) + p, turned[e]);
          }
        }
      }
    }
  }

  // The row of one particle, wherever its nodes lie; zero in columns that there are not.
  MPMJAX_NOINLINE void copy_row(int row, int particle, T* to) const {
    std::memset(to, 0, numbers * sizeof(T));
    for (int j = 0; j < s; ++j) {
      const int64_t clipped = std::clamp<int64_t>(block.node(row, particle, j), 0, size - 1);
      std::memcpy(to + j * columns, from + clipped * stride, used * sizeof(T));
    }
  }

  // The sums over the axes from a on, of rows from a first one on.
  template <class Sums, int a = 0, class Read, class... Given>
  MPMJAX_INLINE auto sum_from(int first, const Read& read_row, const Given&... given) const {
    constexpr int last = d - 1;
    typename Sums::template At<a> total;
    if constexpr (a == last) {
      const auto row = read_row(first);
      each<s>([&](int j) MPMJAX_INLINE_LAMBDA { total.add(*this, j, Sums::node(row, j, given...)); });
    } else {
      each<s, Sums::unrolled && a + 1 == last>([&](int i) MPMJAX_INLINE_LAMBDA {
        total.add(*this, i, sum_from<Sums, a + 1>(s * first + i, read_row, given...));
      });
    }
    return total;
  }

  // The sums over all nodes, which a pull takes times what is given, and of stored rows alone: half the code.
  template <class Sums, class... Given>
  MPMJAX_INLINE auto sum(const Given&... given) const {
    if constexpr (permutes && sizeof...(given) == 0) {
      if (joined) {
        return sum_from<Sums>(0, [&](int i) MPMJAX_INLINE_LAMBDA { return runs.row(block, q, from, i); });
      }
    }
    return sum_from<Sums>(0, [&](int i) MPMJAX_INLINE_LAMBDA { return stored[i]; }, given...);
  }

  MPMJAX_INLINE auto gather() const { return sum<GatherSums<T, d, s, columns>>(); }

  // The numbers of these particles among those of a block.
  MPMJAX_INLINE Simd<T> at(const T* numbers) const { return load_as<Simd<T>>(numbers + q); }
};

// Stores the columns that are used of a gather, or adds them to what is there. Only what is common is stored in place:
// all would take as long to compile as the sums.
template <int d, class T, class Sums>
MPMJAX_INLINE void put(const ParticleLanes<T>& lanes, const Sums& sums, int64_t column, int used, int64_t rows,
                       T* value, T* gradients, bool add = false) {
  const auto put_lanes = [=](auto all, const Sums& sums, bool add) MPMJAX_INLINE_LAMBDA {
    const auto store = [&](T* to, int64_t row, Simd<T> v) MPMJAX_INLINE_LAMBDA {
      lanes.template store<all>(to, row, add ? v + lanes.template load<all>(to, row) : v);
    };
    for (int c = 0; c < used; ++c) {
      store(value, column + c, sums.value[c]);
      for (int b = 0; b < d; ++b) store(gradients, b * rows + column + c, sums.gradients[b][c]);
    }
  };
  const auto put_rarely = [=](const Sums& sums) MPMJAX_NOINLINE {
    by_lanes(lanes, [&](auto all) MPMJAX_INLINE_LAMBDA { put_lanes(all, sums, add); });
  };
  if (lanes.whole() && !add) return put_lanes(std::true_type(), sums, false);
  const Sums apart = sums;  // so that they need no place in memory
  put_rarely(apart);
}

template <class T, int d, int s, int columns>
void gather_columns(const Gather<T>& task, int64_t first, int64_t last) {
  for (int64_t start = first; start < last; start += kBlock) {
    const int count = smaller(last - start, kBlock);
    Block<T, d, s> block;
    block.find_range(task.stencils, start, count);
    for (int pass = 0; pass < passes<d>(task.stencils); ++pass) {
      block.evaluate(task.stencils, start, count, differentiated(task.stencils, pass));
      for (int64_t c = 0; c < task.columns; c += columns == 0 ? kLanes : columns) {
        for (int q = 0; q < count; q += kSimdLanes<T>) {
          const Nodes<T, d, s, columns> nodes(block, q, task.nodes, task.size, task.columns, c);
          const ParticleLanes<T> lanes(start + q, last, task.stencils.particles);
          put<d>(lanes, nodes.gather(), c, nodes.used, task.columns, task.value, task.gradients, pass > 0);
        }
      }
    }
  }
}

template <class T, int d, int s>
void g2p(const G2P<T>& task, int64_t first, int64_t last) {
  for (int64_t start = first; start < last; start += kBlock) {
    const int count = smaller(last - start, kBlock);
    Block<T, d, s> block;
    block.find_range(task.stencils, start, count);
    block.evaluate(task.stencils, start, count);
    for (int q = 0; q < count; q += kSimdLanes<T>) {
      const Nodes<T, d, s, d> nodes(block, q, task.nodes, task.size, d, 0);
      const auto sums = nodes.gather();
      const ParticleLanes<T> lanes(start + q, last, task.stencils.particles);
      for (int r = 0; r < d * d; ++r) {
        const int64_t place = r * task.stencils.particles + start + q;
        if (r < d) prefetch<true>(task.value + place), prefetch<true>(task.moved + place);
        prefetch<true>(task.gradient + place);
        if (task.F != nullptr) prefetch<true>(task.strained + place);
      }
      by_lanes(lanes, [&](auto all) MPMJAX_INLINE_LAMBDA {
        move<d>(
            task, sums.value, sums.gradients,
            [&](const T* from, int row) MPMJAX_INLINE_LAMBDA { return lanes.template load<all>(from, row); },
            [&](T* to, int row, Simd<T> v) MPMJAX_INLINE_LAMBDA { lanes.template store<all>(to, row, v); });
      });
    }
  }
}

template <class T, int d, int s, int columns_>
void pull_columns(const Pull<T>& task, int64_t first, int64_t last) {
  constexpr int columns = columns_ == 0 ? kLanes : columns_;
  for (int64_t start = first; start < last; start += kBlock) {
    const int count = smaller(last - start, kBlock);
    Block<T, d, s> block, derivatives;
    block.find_range(task.stencils, start, count);
    block.evaluate(task.stencils, start, count);
    std::memcpy(derivatives.offset, block.offset, sizeof block.offset);
    derivatives.evaluate(task.stencils, start, count, ~0u);
    for (int q = 0; q < count; q += kSimdLanes<T>) {
      const ParticleLanes<T> lanes(start + q, last, task.stencils.particles);
      for (int64_t c = 0; c < task.columns; c += columns) {
        const Nodes<T, d, s, columns_> nodes(block, q, task.nodes, task.size, task.columns, c, &derivatives);
        const GivenValues<T, d, columns> given(lanes, task, c, nodes.used);
        const auto result = nodes.template sum<PullSums<T, d, s, columns>>(given);
        by_lanes(lanes, [&](auto all) MPMJAX_INLINE_LAMBDA {
          for (int a = 0; a < d; ++a) {
            const Simd<T> before = c == 0 ? Simd<T>{} : lanes.template load<all>(task.by_place, a);
            lanes.template store<all>(task.by_place, a, before + result.by[a + 1][0]);
          }
        });
        if (task.value == nullptr) continue;
        put<d>(lanes, result.gathered, c, nodes.used, task.columns, task.value, task.gradients);
      }
    }
  }
}

template <class T, int d, int s>
void gather(const Gather<T>& task, int64_t first, int64_t last) {
  if constexpr (d > 1) {
    if (task.columns == 1) return gather_columns<T, d, s, 1>(task, first, last);
    if (task.columns == d) return gather_columns<T, d, s, d>(task, first, last);
    if (task.columns == d + 1) return gather_columns<T, d, s, d + 1>(task, first, last);
  }
  gather_columns<T, d, s, 0>(task, first, last);
}

template <class T, int d, int s>
void pull(const Pull<T>& task, int64_t first, int64_t last) {
  if constexpr (d > 1) {
    if (task.columns == d) return pull_columns<T, d, s, d>(task, first, last);
    if (task.columns == d + 1) return pull_columns<T, d, s, d + 1>(task, first, last);
  }
  pull_columns<T, d, s, 0>(task, first, last);
}

}  // namespace
