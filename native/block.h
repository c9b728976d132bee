// A block of particles: their polynomials and index, copied to the stack.
//
// Arrays (d, p) and (c, p) are some forty streams. When p is a power of two they all fall on the same lines of a cache,
// so each is read in whole lines.

#pragma once

#include "problems.h"
#include "row.h"

namespace {

using mpmjax::kBlock;
using mpmjax::Stencils;

constexpr int kSafeBits = 29;  // three terms of fewer bits add up to fewer than 32
constexpr int kAhead = 4 * kBlock;
constexpr int kRoom = kBlock + 3;  // a block's rows of four, with room for what is read beyond the last one

MPMJAX_INLINE int smaller(int64_t a, int b) { return a < b ? static_cast<int>(a) : b; }

// A flat index from its terms, wrapping as XLA's integers do.
MPMJAX_INLINE int32_t wrapping_sum(int32_t first, int32_t term) {
  return static_cast<int32_t>(static_cast<uint32_t>(first) + static_cast<uint32_t>(term));
}

// The same for a whole block.
typedef int32_t BlockInt __attribute__((vector_size(kBlock * sizeof(int32_t))));
typedef uint32_t BlockUint __attribute__((vector_size(kBlock * sizeof(int32_t))));
MPMJAX_INLINE BlockInt wrapping_sum(BlockInt first, BlockInt term) {
  return (BlockInt)((BlockUint)first + (BlockUint)term);
}

// Asks for what a later block has of an array, to read it or to write it. Blocks come one after the other, in more
// streams than a processor foresees by itself.
template <bool to_write = false, class T>
MPMJAX_INLINE void prefetch(const T* from) {
  const uintptr_t later = reinterpret_cast<uintptr_t>(from) + kAhead * sizeof(T);  // perhaps beyond the array's end
  __builtin_prefetch(reinterpret_cast<const void*>(later), to_write);
}

template <bool to_write = false, class T>
MPMJAX_INLINE void prefetch_block(const T* from) {
  prefetch<to_write>(from);
  if (kBlock * sizeof(T) > 64) prefetch<to_write>(from + kBlock / 2);
}

// Copies up to a block of numbers; what is missing is zero.
template <class T>
MPMJAX_NOINLINE void copy_partial(const T* from, int count, T* to) {
  std::memset(to, 0, kBlock * sizeof(T));
  std::copy(from, from + count, to);
}
template <class T>
MPMJAX_INLINE void copy(const T* from, int count, T* to) {
  if (__builtin_expect(count != kBlock, 0)) return copy_partial(from, count, to);
  std::memcpy(to, from, kBlock * sizeof(T));
  prefetch_block(from);
}

// Copies back as many numbers as there are.
template <class T>
MPMJAX_INLINE void write(const T* from, int count, T* to) {
  if (count != kBlock) return void(std::copy(from, from + count, to));
  std::memcpy(to, from, kBlock * sizeof(T));
  prefetch_block<true>(to);
}

// A block's columns as rows of four, with zeros in those that there are not.
template <class T, int columns>
MPMJAX_INLINE void to_rows(const T (*from)[kBlock], Vector<T>* rows) {
  for (int q = 0; q < kBlock; q += kSimdLanes<T>) {
    Simd<T> read[kLanes] = {};
    for (int c = 0; c < columns; ++c) read[c] = load_as<Simd<T>>(from[c] + q);
    to_rows(read, rows + q);
  }
}

// For each lane the one before it; the first one itself.
template <int... lane>
constexpr auto before_of(std::integer_sequence<int, lane...>) {
  return std::integer_sequence<int, (lane > 0 ? lane - 1 : 0)...>();
}

// The first nodes of particles along an axis, ⌊ξ − (s − 2)/2⌋, without meaning beyond 2³⁰. What is no number is on the
// window's first node, as XLA has it.
template <int s, class T>
MPMJAX_INLINE Simd<T> first_of(Simd<T> place) {
  constexpr T kFar = 1 << 30;
  const Simd<T> low = place - T(s - 2) / 2, least = low == low ? Simd<T>{} - kFar : Simd<T>{};
  const Simd<T> near = low > -kFar ? (low < kFar ? low : -least) : least;
  using Index = LanesOf<float, kSimdLanes<T>>;
  const Simd<T> whole = __builtin_convertvector(__builtin_convertvector(near, Index), Simd<T>);
  return whole > near ? whole - 1 : whole;
}

// The weights of a block and their slopes along each axis.
template <class T, int d, int s>
struct Block {
  int32_t index[d][s][kBlock];
  T offset[d][kBlock];  // from the middle of the places that have the same nodes
  T weights[d][s][kBlock];
  T slopes[d][s][kBlock];
  // The last axis' of each particle as rows of four.
  Vector<T> last_weights[kRoom], last_slopes[kRoom];
  int32_t contiguous[kBlock];  // whether the nodes along the last axis follow each other
  int32_t same_nodes[kBlock];  // whether the nodes are those of the particle before in the block
  // The least and the largest flat index of a particle's nodes, and those from the axes after the first alone.
  int32_t least[kBlock], most[kBlock];
  int32_t least_beyond[kBlock], most_beyond[kBlock];

  // The polynomials at the offsets that `find_range` found, with derivatives along some axes, a bit each, times dξ if
  // there is one; those of no particle are zero.
  MPMJAX_NOINLINE void evaluate(const Stencils<T>& from, int64_t first, int count, unsigned differentiated = 0) {
    for (int a = 0; a < d; ++a) {
      T dt[kBlock];
      if (!(differentiated >> a & 1)) {
        set<0>(from.basis, a, offset[a], count, nullptr);
      } else if (from.change == nullptr) {
        set<1>(from.basis, a, offset[a], count, nullptr);
      } else {
        copy(from.change + a * from.particles + first, count, dt);
        set<1>(from.basis, a, offset[a], count, dt);
      }
    }
  }

  // Σ_k c_k (t − τ)^k for each node, or the derivative Σ_k k c_k (t − τ)^(k−1), times a factor if there is one.
  template <int order>
  MPMJAX_INLINE void set(const mpmjax::Basis<T>& basis, int a, const T* t, int count, const T* factor) {
    for (int q = 0; q < kBlock; q += kSimdLanes<T>) {
      Simd<T> sums[2][s] = {};
      for (int k = basis.terms - 1; k >= order; --k) {
        const T times = order == 1 ? T(k) : T(1);
#pragma GCC unroll 4
        for (int i = 0; i < s; ++i) {
          const Simd<T> x = load_as<Simd<T>>(t + q) - basis.knots[i];
          sums[0][i] = sums[0][i] * x + times * basis.weights[i][k];
          sums[1][i] = sums[1][i] * x + times * basis.slopes[i][k];
        }
      }
      const Simd<T> by = factor == nullptr ? Simd<T>{} + 1 : load_as<Simd<T>>(factor + q);
#pragma GCC unroll 4
      for (int i = 0; i < s; ++i) store(weights[a][i] + q, by * sums[0][i]), store(slopes[a][i] + q, by * sums[1][i]);
    }
    for (int i = 0; i < s && count < kBlock; ++i) {
      std::memset(weights[a][i] + count, 0, (kBlock - count) * sizeof(T));
      std::memset(slopes[a][i] + count, 0, (kBlock - count) * sizeof(T));
    }
  }

  // The offsets and the index terms of an axis, (first + i) stride or around a periodic one. Terms wrap as 32-bit
  // integers do: those of a particle outside of the window, or of none, have no meaning, and may be any number.
  MPMJAX_INLINE void read_place(const Stencils<T>& from, int a, int64_t first, int count) {
    T place[kBlock];
    int32_t begin[kBlock];
    copy(from.place + a * from.particles + first, count, place);
    for (int q = 0; q < kBlock; q += kSimdLanes<T>) {
      const Simd<T> xi = load_as<Simd<T>>(place + q), whole = first_of<s, T>(xi);
      store(offset[a] + q, xi - whole - T(s - 1) / 2);
      store(begin + q, __builtin_convertvector(whole, LanesOf<float, kSimdLanes<T>>));
    }
    const uint32_t stride = static_cast<uint32_t>(from.basis.strides[a]);
    BlockUint term = load_as<BlockUint>(begin) * stride;
#pragma GCC unroll 4
    for (int i = 0; i < s; ++i, term += stride) store(index[a][i], term);
    if (from.basis.periodic[a]) wrap_index(from.basis.shape[a], stride, begin, index[a]);
  }

  // Nodes of the same period of so many nodes as the first one.
  static MPMJAX_NOINLINE void wrap_index(int32_t period, uint32_t stride, const int32_t* begin,
                                         int32_t (*terms)[kBlock]) {
    for (int q = 0; q < kBlock; ++q) {
      const int32_t place = begin[q] % period, from_start = place < 0 ? place + period : place;
      for (int i = 0; i < s; ++i) {
        const int32_t node = (from_start + i) % period - from_start;
        terms[i][q] = static_cast<int32_t>((static_cast<uint32_t>(begin[q]) + static_cast<uint32_t>(node)) * stride);
      }
    }
  }

  // The last axis' rows, once the numbers were read.
  MPMJAX_NOINLINE void join_last() {
    to_rows<T, s>(weights[d - 1], last_weights);
    to_rows<T, s>(slopes[d - 1], last_slopes);
  }

  // The range of flat indices, from the terms of the index alone. Where a term is negative or so large that a sum may
  // leave 32 bits and wrap, the range is that of all integers. Terms of an axis that is not periodic grow.
  MPMJAX_NOINLINE void find_range(const Stencils<T>& from, int64_t first, int count) {
    BlockInt large = {}, bent = {}, low_sum = {}, high_sum = {};
#pragma GCC unroll 3
    for (int a = d - 1; a >= 0; --a) {
      read_place(from, a, first, count);
      BlockInt low = load_as<BlockInt>(index[a][0]), high = load_as<BlockInt>(index[a][s - 1]);
      for (int i = 0; i < s && from.basis.periodic[a]; ++i) {
        const BlockInt term = load_as<BlockInt>(index[a][i]);
        if (a == d - 1) bent |= term ^ wrapping_sum(load_as<BlockInt>(index[a][0]), BlockInt{} + i);
        low = term < low ? term : low;
        high = term > high ? term : high;
      }
      large |= low | high | from.basis.strides[a];
      if (a == 0) put(low_sum, high_sum, large, least_beyond, most_beyond);
      low_sum = wrapping_sum(low_sum, low);
      high_sum = wrapping_sum(high_sum, high);
    }
    put(low_sum, high_sum, large, least, most);
    store(contiguous, BlockInt(bent == 0));
  }

  // Finds, from the index, which particles have the nodes of the one before.
  MPMJAX_NOINLINE void find_same_nodes() {
    BlockInt apart = {};
    for (int a = 0; a < d; ++a) {
      for (int i = 0; i < s; ++i) {
        const BlockInt term = load_as<BlockInt>(index[a][i]);
        apart |= term ^ shuffled<BlockInt>(term, before_of(Count<kBlock>()));
      }
    }
    store(same_nodes, BlockInt(apart == 0));
  }

  static MPMJAX_INLINE void put(BlockInt low, BlockInt high, BlockInt large, int32_t* to_least, int32_t* to_most) {
    const BlockInt all = large >> kSafeBits;
    store(to_least, all != 0 ? BlockInt{} + INT32_MIN : low);
    store(to_most, all != 0 ? BlockInt{} + INT32_MAX : high);
  }

  // The flat index of the j-th node of a row, in C order of the axes before the last. It wraps, as read_place says.
  MPMJAX_INLINE int32_t node(int row, int q, int j = 0) const {
    int32_t sum = index[d - 1][j][q];
    if constexpr (d == 2) sum = wrapping_sum(index[0][row][q], sum);
    if constexpr (d == 3) sum = wrapping_sum(wrapping_sum(index[0][row / s][q], index[1][row % s][q]), sum);
    return sum;
  }
};

// Four columns of a block's rows: from (c, p), of which `used` columns exist, the row of each particle.
template <class T>
MPMJAX_NOINLINE void read_rows(const T* from, int64_t particles, int count, int used, Vector<T>* rows) {
  alignas(64) T columns[kLanes][kBlock];
  for (int c = 0; c < kLanes; ++c) copy(from + (c < used ? c : 0) * particles, c < used ? count : 0, columns[c]);
  to_rows<T, kLanes>(columns, rows);
}

// A differential along dξ is a sum over the axes, of the same sums with derivatives along one of them: a pass for each.
// The sum itself is one pass, with no derivative.
template <int d, class T>
MPMJAX_INLINE int passes(const Stencils<T>& stencils) {
  return stencils.change == nullptr ? 1 : d;
}
template <class T>
MPMJAX_INLINE unsigned differentiated(const Stencils<T>& stencils, int pass) {
  return stencils.change == nullptr ? 0 : 1u << pass;
}

}  // namespace
