// A few particles at a time: their factors and rows, copied to the stack.
//
// Arrays (d, s, p) and (c, p) are some forty streams. When p is a power of two they all fall on the same lines of a
// cache, so each is read in whole lines.

#pragma once

#include "problems.h"
#include "vector.h"

namespace {

using mpmjax::kBlock;
using mpmjax::Stencils;

constexpr int kSafeBits = 29;  // three terms of fewer bits add up to fewer than 32
constexpr int kAhead = 4 * kBlock;

// A flat index from its terms, wrapping as XLA's integers do.
MPMJAX_INLINE int32_t after(int32_t first, int32_t term) {
  return static_cast<int32_t>(static_cast<uint32_t>(first) + static_cast<uint32_t>(term));
}

// Copies up to a block of numbers; what is missing is zero.
template <class T>
MPMJAX_APART void copy_some(const T* from, int count, T* to) {
  std::memset(to, 0, kBlock * sizeof(T));
  for (int q = 0; q < count; ++q) to[q] = from[q];
}

// Asks for what a later block has of an array. Blocks come one after the other, in more streams than a processor foresees
// by itself.
template <class T>
MPMJAX_INLINE void ask(const T* from) {
  const uintptr_t later = reinterpret_cast<uintptr_t>(from) + kAhead * sizeof(T);  // perhaps beyond the array's end
  __builtin_prefetch(reinterpret_cast<const void*>(later));
}

// Copies a block, or what there is of it.
template <class T>
MPMJAX_INLINE void copy(const T* from, int count, T* to) {
  if (__builtin_expect(count != kBlock, 0)) return copy_some(from, count, to);
  std::memcpy(to, from, kBlock * sizeof(T));
  ask(from);
  if (kBlock * sizeof(T) > 64) ask(from + kBlock / 2);
}

// The factors of a block: numbers, or with `differential` numbers with their changes.
template <class T, int d, int s, bool differential>
struct Block {
  int32_t index[d][s][kBlock];
  T weights[d][s][kBlock];
  T derivatives[d][s][kBlock];
  T weight_changes[differential ? d : 1][s][kBlock];
  T derivative_changes[differential ? d : 1][s][kBlock];
  // The least and the largest flat index of a particle's nodes, and those from the
  // axes after the first alone.
  int32_t least[kBlock], most[kBlock];
  int32_t least_beyond[kBlock], most_beyond[kBlock];

  // The numbers; the index is read by `find_range`.
  MPMJAX_APART void read(const Stencils<T>& from, int64_t first, int count) {
    for (int a = 0; a < d; ++a) {
      for (int i = 0; i < s; ++i) {
        const int64_t at = (a * s + i) * from.particles + first;
        copy(from.weights + at, count, weights[a][i]);
        copy(from.derivatives + at, count, derivatives[a][i]);
        if constexpr (differential) {
          copy(from.weight_changes + at, count, weight_changes[a][i]);
          copy(from.derivative_changes + at, count, derivative_changes[a][i]);
        }
      }
    }
  }

  // The range of flat indices, from the terms of the index alone. Where a term is so large that a sum may leave 32 bits
  // and wrap, the range is that of all integers.
  MPMJAX_APART void find_range(const Stencils<T>& from, int64_t first, int count) {
    int32_t large[kBlock] = {};
    for (int q = 0; q < kBlock; ++q) least_beyond[q] = most_beyond[q] = 0;
    for (int a = d - 1; a >= 0; --a) {
      int32_t low[kBlock], high[kBlock];
      for (int i = 0; i < s; ++i) {
        int32_t* term = index[a][i];
        copy(from.index + (a * s + i) * from.particles + first, count, term);
        for (int q = 0; q < kBlock; ++q) {
          low[q] = i == 0 || term[q] < low[q] ? term[q] : low[q];
          high[q] = i == 0 || term[q] > high[q] ? term[q] : high[q];
          large[q] |= (term[q] ^ (term[q] >> 31)) >> kSafeBits;
        }
      }
      int32_t* to_least = a == 0 ? least : least_beyond;
      int32_t* to_most = a == 0 ? most : most_beyond;
      for (int q = 0; q < kBlock; ++q) {
        to_least[q] = after(least_beyond[q], low[q]);
        to_most[q] = after(most_beyond[q], high[q]);
      }
    }
    for (int q = 0; q < kBlock; ++q) {
      least[q] = large[q] ? INT32_MIN : least[q];
      most[q] = large[q] ? INT32_MAX : most[q];
      least_beyond[q] = large[q] ? INT32_MIN : least_beyond[q];
      most_beyond[q] = large[q] ? INT32_MAX : most_beyond[q];
    }
  }

  MPMJAX_INLINE auto weight(int a, int i, int q) const {
    if constexpr (differential) {
      return Dual<T>{weights[a][i][q], weight_changes[a][i][q]};
    } else {
      return weights[a][i][q];
    }
  }

  MPMJAX_INLINE auto derivative(int a, int i, int q) const {
    if constexpr (differential) {
      return Dual<T>{derivatives[a][i][q], derivative_changes[a][i][q]};
    } else {
      return derivatives[a][i][q];
    }
  }
};

// Copies back as many numbers as there are.
template <class T>
MPMJAX_INLINE void write(const T* from, int count, T* to) {
  if (count == kBlock) {
    std::memcpy(to, from, kBlock * sizeof(T));
  } else {
    for (int q = 0; q < count; ++q) to[q] = from[q];
  }
}

// Columns of a block as rows: row q has the q-th number of each column.
template <class T>
MPMJAX_INLINE void join(const T (*columns)[kBlock], Vector<T>* rows) {
  for (int q = 0; q < kBlock; q += kLanes) {
    Vector<T> turned[kLanes];
    for (int c = 0; c < kLanes; ++c) turned[c] = load(columns[c] + q);
    transpose<T>(turned, rows + q);
  }
}

// The other way round.
template <class T>
MPMJAX_INLINE void split(const Vector<T>* rows, T (*columns)[kBlock]) {
  for (int q = 0; q < kBlock; q += kLanes) {
    Vector<T> turned[kLanes];
    transpose<T>(rows + q, turned);
    for (int c = 0; c < kLanes; ++c) store(columns[c] + q, turned[c]);
  }
}

// Four columns of a block's rows: from (c, p), of which `used` columns exist, the row of each particle.
template <class T>
MPMJAX_APART void read_rows(const T* from, int64_t particles, int count, int used, Vector<T>* rows) {
  alignas(64) T columns[kLanes][kBlock];
  for (int c = 0; c < kLanes; ++c) copy(from + (c < used ? c : 0) * particles, c < used ? count : 0, columns[c]);
  join<T>(columns, rows);
}

// The other way round: writes the rows of a block as columns of (c, p).
template <class T>
MPMJAX_APART void write_rows(const Vector<T>* rows, T* to, int64_t particles, int count, int used) {
  alignas(64) T columns[kLanes][kBlock];
  split<T>(rows, columns);
  for (int c = 0; c < used; ++c) write(columns[c], count, to + c * particles);
}

MPMJAX_INLINE int smaller(int64_t a, int b) { return a < b ? static_cast<int>(a) : b; }

}  // namespace
