// A few particles at a time: their factors and rows, copied to the stack.
//
// Arrays (d, s, p) and (c, p) are some forty streams. When p is a power of two they all fall on the same lines of a
// cache, so each is read in whole lines.

#pragma once

#include "problems.h"
#include "row.h"

namespace {

using mpmjax::Given;
using mpmjax::kBlock;
using mpmjax::Places;
using mpmjax::Stencils;

constexpr int kSafeBits = 29;  // three terms of fewer bits add up to fewer than 32
constexpr int kAhead = 4 * kBlock;
constexpr int kRoom = kBlock + 3;  // a block's rows of four, with room for what is read beyond the last one

MPMJAX_INLINE int smaller(int64_t a, int b) { return a < b ? static_cast<int>(a) : b; }

// A flat index from its terms, wrapping as XLA's integers do.
MPMJAX_INLINE int32_t after(int32_t first, int32_t term) {
  return static_cast<int32_t>(static_cast<uint32_t>(first) + static_cast<uint32_t>(term));
}

// The same for a whole block.
typedef int32_t Whole __attribute__((vector_size(kBlock * sizeof(int32_t))));
typedef uint32_t Wrapping __attribute__((vector_size(kBlock * sizeof(int32_t))));
MPMJAX_INLINE Whole after(Whole first, Whole term) { return (Whole)((Wrapping)first + (Wrapping)term); }

// Copies up to a block of numbers; what is missing is zero.
template <class T>
MPMJAX_APART void copy_some(const T* from, int count, T* to) {
  std::memset(to, 0, kBlock * sizeof(T));
  for (int q = 0; q < count; ++q) to[q] = from[q];
}

// Asks for what a later block has of an array, to read it or to write it. Blocks come one after the other, in more streams
// than a processor foresees by itself.
template <bool to_write = false, class T>
MPMJAX_INLINE void ask(const T* from) {
  const uintptr_t later = reinterpret_cast<uintptr_t>(from) + kAhead * sizeof(T);  // perhaps beyond the array's end
  __builtin_prefetch(reinterpret_cast<const void*>(later), to_write);
}

// Copies a block, or what there is of it.
template <class T>
MPMJAX_INLINE void copy(const T* from, int count, T* to) {
  if (__builtin_expect(count != kBlock, 0)) return copy_some(from, count, to);
  std::memcpy(to, from, kBlock * sizeof(T));
  ask(from);
  if (kBlock * sizeof(T) > 64) ask(from + kBlock / 2);
}

// Columns of a block as rows: row q has the q-th number of each column, and zeros.
template <class T, int columns>
MPMJAX_INLINE void join(const T (*from)[kBlock], Vector<T>* rows) {
  for (int q = 0; q < kBlock; q += kLanes) {
    Vector<T> turned[kLanes] = {};
    for (int c = 0; c < columns; ++c) turned[c] = load(from[c] + q);
    transpose<T>(turned, rows + q);
  }
}

// For each lane the one before it; the first one itself.
template <int... lane>
constexpr auto before_of(std::integer_sequence<int, lane...>) {
  return std::integer_sequence<int, (lane > 0 ? lane - 1 : 0)...>();
}

// The factors of a block: numbers, or with `differential` numbers with their changes.
template <class T, int d, int s, bool differential>
struct Block {
  static constexpr int axes = d, terms = s + 1;

  int32_t index[d][s][kBlock];
  T weights[d][s][kBlock];
  T derivatives[d][s][kBlock];
  T weight_changes[differential ? d : 1][s][kBlock];
  T derivative_changes[differential ? d : 1][s][kBlock];
  // The last axis' factors of each particle as rows of four.
  Vector<T> last_weights[kRoom], last_derivatives[kRoom];
  Vector<T> last_weight_changes[differential ? kRoom : 1], last_derivative_changes[differential ? kRoom : 1];
  // Whether the nodes along the last axis follow each other.
  int32_t straight[kBlock];
  // Whether the nodes are those of the particle before in the block.
  int32_t alike[kBlock];
  // The least and the largest flat index of a particle's nodes, and those from the axes after the first alone.
  int32_t least[kBlock], most[kBlock];
  int32_t least_beyond[kBlock], most_beyond[kBlock];

  // The numbers; the index is read by `find_range`.
  MPMJAX_APART void read(const Stencils<T>& from, int64_t first, int count) {
    if constexpr (!differential) {
      if (from.places.first != nullptr) return evaluate(from.places, from.particles, first, count);
    }
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

  // The numbers of particles whose places are given. Those of no particle are zero.
  MPMJAX_APART void evaluate(const Places<T>& from, int64_t particles, int64_t first, int count) {
    typedef T Some __attribute__((vector_size(kBlock * sizeof(T))));
    for (int a = 0; a < d; ++a) {
      T offset[kBlock];
      copy(from.offset + a * particles + first, count, offset);
      Some t;
      std::memcpy(&t, offset, sizeof t);
#pragma GCC unroll 4
      for (int i = 0; i < s; ++i) {
        put(value(from.polynomials + i * (terms + 1), t), count, weights[a][i]);
        put(value(from.polynomials + (s + i) * (terms + 1), t), count, derivatives[a][i]);
      }
    }
  }

  // Σ_k c_k (t − τ)^k, of τ and then the c.
  template <class V>
  static MPMJAX_INLINE V value(const T* numbers, V t) {
    const V from = t - numbers[0];
    V sum = V{} + numbers[terms];
#pragma GCC unroll 4
    for (int k = terms - 1; k > 0; --k) sum = sum * from + numbers[k];
    return sum;
  }

  // Stores numbers of a block, those of no particle as zero.
  template <class V, class X>
  static MPMJAX_INLINE void put(V numbers, int count, X* to) {
    std::memcpy(to, &numbers, sizeof numbers);
    for (int q = count; q < kBlock; ++q) to[q] = 0;
  }

  // The index terms of an axis, with zero for no particle.
  MPMJAX_INLINE void read_index(const Stencils<T>& from, int a, int64_t first, int count) {
    const Places<T>& places = from.places;
    if (places.first == nullptr) {
#pragma GCC unroll 4
      for (int i = 0; i < s; ++i) copy(from.index + (a * s + i) * from.particles + first, count, index[a][i]);
      return;
    }
    int32_t begin[kBlock];
    copy(places.first + a * from.particles + first, count, begin);
    const uint32_t stride = static_cast<uint32_t>(places.strides[a]);
    Wrapping term;
    std::memcpy(&term, begin, sizeof term);
    term *= stride;
#pragma GCC unroll 4
    for (int i = 0; i < s; ++i, term += stride) put(term, count, index[a][i]);
  }

  // The last axis' rows, once the numbers were read.
  MPMJAX_APART void join_last() {
    join<T, s>(weights[d - 1], last_weights);
    join<T, s>(derivatives[d - 1], last_derivatives);
    if constexpr (differential) {
      join<T, s>(weight_changes[d - 1], last_weight_changes);
      join<T, s>(derivative_changes[d - 1], last_derivative_changes);
    }
  }

  // The range of flat indices, from the terms of the index alone. Where a term is so large that a sum may leave 32 bits
  // and wrap, the range is that of all integers.
  MPMJAX_APART void find_range(const Stencils<T>& from, int64_t first, int count) {
    Whole large = {}, bent = {}, low_sum = {}, high_sum = {};
    for (int a = d - 1; a >= 0; --a) {
      Whole first_term = {}, low = {}, high = {};
      read_index(from, a, first, count);
#pragma GCC unroll 4
      for (int i = 0; i < s; ++i) {
        Whole term;
        std::memcpy(&term, index[a][i], sizeof term);
        if (i == 0) first_term = low = high = term;
        low = term < low ? term : low;
        high = term > high ? term : high;
        large |= (term ^ (term >> 31)) >> kSafeBits;
        if (a == d - 1) bent |= term ^ after(first_term, Whole{} + i);
      }
      if (a == 0) put(low_sum, high_sum, large, least_beyond, most_beyond);
      low_sum = after(low_sum, low);
      high_sum = after(high_sum, high);
    }
    put(low_sum, high_sum, large, least, most);
    const Whole even = bent == 0;
    std::memcpy(straight, &even, sizeof even);
  }

  // Finds, from the index, which particles have the nodes of the one before.
  MPMJAX_APART void find_alike() {
    Whole apart = {};
    for (int a = 0; a < d; ++a) {
      for (int i = 0; i < s; ++i) {
        Whole term;
        std::memcpy(&term, index[a][i], sizeof term);
        apart |= term ^ chosen<Whole>(term, before_of(Count<kBlock>()));
      }
    }
    const Whole same = apart == 0;
    std::memcpy(alike, &same, sizeof same);
  }

  static MPMJAX_INLINE void put(Whole low, Whole high, Whole large, int32_t* to_least, int32_t* to_most) {
    low = large != 0 ? Whole{} + INT32_MIN : low;
    high = large != 0 ? Whole{} + INT32_MAX : high;
    std::memcpy(to_least, &low, sizeof low);
    std::memcpy(to_most, &high, sizeof high);
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

  // The same of the last axis, for all its nodes.
  template <class R>
  MPMJAX_INLINE auto last_weight(int q) const {
    if constexpr (differential) {
      return Dual<R>{by_node<R, T>(last_weights[q]), by_node<R, T>(last_weight_changes[q])};
    } else {
      return by_node<R, T>(last_weights[q]);
    }
  }

  template <class R>
  MPMJAX_INLINE auto last_derivative(int q) const {
    if constexpr (differential) {
      return Dual<R>{by_node<R, T>(last_derivatives[q]), by_node<R, T>(last_derivative_changes[q])};
    } else {
      return by_node<R, T>(last_derivatives[q]);
    }
  }
};

// Copies back as many numbers as there are.
template <class T>
MPMJAX_INLINE void write(const T* from, int count, T* to) {
  if (count == kBlock) {
    std::memcpy(to, from, kBlock * sizeof(T));
    ask<true>(to);
    if (kBlock * sizeof(T) > 64) ask<true>(to + kBlock / 2);
  } else {
    for (int q = 0; q < count; ++q) to[q] = from[q];
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
  join<T, kLanes>(columns, rows);
}

// The rows of what a block's particles give, up to four columns of the value and with `graded` of each gradient after it.
template <class T, int d, bool graded>
MPMJAX_INLINE void read_given(const Given<T>& given, int64_t particles, int64_t column, int used, int64_t start, int count,
                              Vector<T> (*rows)[kRoom]) {
  const auto read = [&](const T* from, int64_t columns, Vector<T>* to) MPMJAX_INLINE_LAMBDA {
    if (from == nullptr || column >= columns) {
      std::memset(to, 0, kRoom * sizeof *to);
    } else {
      read_rows(from + column * particles + start, particles, count, smaller(columns - column, used), to);
    }
  };
  read(given.value, column + used, rows[0]);
  if constexpr (graded) {
    const int64_t each = given.graded * particles;
    for (int b = 0; b < d; ++b) {
      read(given.gradients == nullptr ? nullptr : given.gradients + b * each, given.graded, rows[b + 1]);
    }
  }
}

// The other way round: writes the rows of a block as columns of (c, p).
template <class T>
MPMJAX_APART void write_rows(const Vector<T>* rows, T* to, int64_t particles, int count, int used) {
  alignas(64) T columns[kLanes][kBlock];
  split<T>(rows, columns);
  for (int c = 0; c < used; ++c) write(columns[c], count, to + c * particles);
}

}  // namespace
