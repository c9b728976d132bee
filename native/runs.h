// Runs: particles abreast that follow one another along the last axis of the grid, so that one row of nodes has what
// all of them read. It is read once, and each lane takes its nodes from it by a permutation.
//
// So lie the particles of a lattice, and those that were sorted by cell.

#pragma once

#include "block.h"
#if defined(__AVX2__)
#include <immintrin.h>
#endif

namespace {

// Whether a vector has an instruction that permutes its lanes, and lanes enough for the nodes of several particles.
template <class T>
#if defined(__AVX2__)
constexpr bool kPermutes = kSimdLanes<T> >= 8;
#else
constexpr bool kPermutes = false;
#endif

// The lanes of a vector that indices name.
template <class T, class M>
MPMJAX_INLINE Simd<T> permuted(Simd<T> v, M lanes) {
#if !defined(__clang__)
  return __builtin_shuffle(v, lanes);
#elif defined(__AVX512F__)
  if constexpr (sizeof(T) == 4) return (Simd<T>)_mm512_permutexvar_ps((__m512i)lanes, (__m512)v);
  if constexpr (sizeof(T) == 8) return (Simd<T>)_mm512_permutexvar_pd((__m512i)lanes, (__m512d)v);
#elif defined(__AVX2__)
  return (Simd<T>)_mm256_permutevar8x32_ps((__m256)v, (__m256i)lanes);
#endif
}

// A bit for each lane where a comparison holds.
#if defined(__AVX512F__)
MPMJAX_INLINE uint32_t bits(LanesOf<float, 16> where) { return _mm512_movepi32_mask((__m512i)where); }
#endif
#if defined(__AVX2__)
MPMJAX_INLINE uint32_t bits(LanesOf<float, 8> where) { return _mm256_movemask_ps((__m256)where); }
#endif

// For column c of nodes that lie in several vectors one after the other: what a lane takes where the first `part` of
// these are joined already and the next one is added.
constexpr int taken(int lanes, int columns, int c, int part, int lane) {
  const int number = lane * columns + c, from = number / lanes;
  return from == part ? lanes + number % lanes : from == 0 && part == 1 ? number : lane;
}
template <int columns, int c, int part, int... lane>
constexpr auto taken_of(std::integer_sequence<int, lane...>) {
  return std::integer_sequence<int, taken(sizeof...(lane), columns, c, part, lane)...>();
}

// One column of as many nodes as there are lanes, which lie in these parts.
template <class T, int columns, int c, int part = 1>
MPMJAX_INLINE Simd<T> column_of(const Simd<T>* parts, Simd<T> joined) {
  if constexpr (part == columns) {
    return joined;
  } else {
    const auto next = shuffled(joined, parts[part], taken_of<columns, c, part>(Count<kSimdLanes<T>>()));
    return column_of<T, columns, c, part + 1>(parts, next);
  }
}

// The nodes along the last axis with all their columns, for a particle in each lane.
template <class T, int s, int columns>
struct NodeRow {
  static constexpr int numbers = s * columns;
  Simd<T> at[numbers];
};

// The runs among some particles of a block.
template <class T, int d, int s, int columns>
class Runs {
 public:
  // Finds the runs of the particles of a block from the q-th on, which all lie within the window. Rows are read from
  // one node before a run's first particle on. Returns false where runs are many, or so near an end of the window that
  // a row would reach beyond it.
  MPMJAX_INLINE bool find(const Block<T, d, s>& block, int q, int64_t size) {
    Index apart = {};  // not zero where the rows are not those of the particle before
    for (int a = 0; a < last; ++a) {
      for (int i = 0; i < s; ++i) {
        const Index terms = load_as<Index>(block.index[a][i] + q);
        apart |= terms ^ shuffled<Index>(terms, before_of(Count<lanes>()));
      }
    }
    const int32_t* place = block.index[last][0] + q;
    const Index terms = load_as<Index>(place);
    const int32_t end = static_cast<int32_t>(std::min<int64_t>(size, INT32_MAX)) - lanes + s;
    const uint32_t near = bits((load_as<Index>(block.least + q) < 1) | (load_as<Index>(block.most + q) > end));
    const uint32_t turns = bits(apart != 0);
    for (int e = 0; e < lanes; ++e) number_[e] = e;
    count_ = 0;
    for (int first = 0; first < lanes && near == 0; ++count_) {
      if (count_ == kMost) return false;
      const Index from = terms - (place[first] - 1);
      first_[count_] = first;
      place_[count_] = __builtin_convertvector(from, Lane);
      const uint32_t ends = (turns | bits((from < 0) | (from > lanes - s))) & (~uint32_t(1) << first);
      first = ends == 0 ? lanes : __builtin_ctz(ends);
    }
    return near == 0;
  }

  // The nodes that the particles read in row i, in C order of the axes before the last.
  MPMJAX_INLINE NodeRow<T, s, columns> row(const Block<T, d, s>& block, int q, const T* nodes, int i) const {
    NodeRow<T, s, columns> row;
    read_run(block, q, nodes, i, 0, [&](int k, Simd<T> v) MPMJAX_INLINE_LAMBDA { row.at[k] = v; });
    for (int r = 1; r < count_; ++r) {
      const Lane meant = number_ >= first_[r];
      read_run(block, q, nodes, i, r, [&](int k, Simd<T> v) MPMJAX_INLINE_LAMBDA {
        row.at[k] = meant ? v : row.at[k];
      });
    }
    return row;
  }

 private:
  static constexpr int lanes = kSimdLanes<T>, last = d - 1, kMost = 4;
  using Lane = LanesOf<T, lanes>;
  using Index = LanesOf<float, lanes>;

  // Calls put(k, number) for each number k of a row of the nodes that a run reads, in all lanes.
  template <class Put>
  MPMJAX_INLINE void read_run(const Block<T, d, s>& block, int q, const T* nodes, int i, int r,
                              const Put& put) const {
    const int64_t index = block.node(i, q + first_[r]) - 1;
    Simd<T> parts[columns];
#pragma GCC unroll 4
    for (int m = 0; m < columns; ++m) std::memcpy(&parts[m], nodes + index * columns + m * lanes, sizeof parts[m]);
    each<columns>([&](auto c) MPMJAX_INLINE_LAMBDA {
      const auto column = column_of<T, columns, decltype(c)::value>(parts, parts[0]);
#pragma GCC unroll 4
      for (int j = 0; j < s; ++j) put(j * columns + c, permuted<T>(column, place_[r] + j));
    });
  }

  int first_[kMost];  // from which lane on each is
  int count_;
  Lane number_, place_[kMost];  // of each lane, and for each run its first node in the row
};

}  // namespace
