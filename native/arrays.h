// Passes over arrays, of a batch, on all threads: vectors of a solve, decompositions, and orders of particles.

#pragma once

#include <algorithm>
#include <array>
#include <memory>
#include <numeric>
#include <vector>

#include "kernels.h"
#include "share.h"

namespace mpmjax {

constexpr int64_t kBlocks = 128;  // of kChunk numbers, some microseconds: what a thread takes at a time
constexpr int64_t kMatrices = 4096;

// Runs a kernel on the blocks of vectors of each of a batch, and adds up what it returns: the same parts in the same
// order for any number of threads.
template <class Problem>
void add_up(const Pool& pool, int64_t batch, const Problem& all, double (*run)(const Problem&, int64_t, int64_t)) {
  const int64_t blocks = blocks_of(all.size), parts = blocks_of(blocks, kBlocks);
  std::vector<double> sums(batch * parts);
  share_parts(pool, batch, blocks, kBlocks, [&](int64_t m, int64_t first, int64_t last) {
    sums[m * parts + first / kBlocks] = run(member(all, m), first, last);
  });
  for (int64_t m = 0; m < batch; ++m) {
    double sum = 0;
    for (int64_t k = 0; k < parts; ++k) sum += sums[m * parts + k];
    all.sum[m] = sum;
  }
}

constexpr int kBits = 11;  // of a digit: its counts stay in the nearest cache
constexpr uint32_t kDigits = 1u << kBits;

// A counting sort by one digit after the other, the last digit first. Digits in which no two keys differ are passed
// over.
inline void sort(const Order& all) {
  if (all.count == 0) return;
  const auto [least, most] = std::minmax_element(all.keys, all.keys + all.count);
  const uint32_t base = static_cast<uint32_t>(*least), reach = static_cast<uint32_t>(*most) - base;
  std::iota(all.order, all.order + all.count, 0);
  const std::unique_ptr<int32_t[]> sorted(new int32_t[all.count]);
  for (int shift = 0; shift < 32 && reach >> shift != 0; shift += kBits) {
    const auto digit = [&](int32_t key) { return ((static_cast<uint32_t>(key) - base) >> shift) % kDigits; };
    std::array<int64_t, kDigits> places = {};
    for (int64_t k = 0; k < all.count; ++k) ++places[digit(all.keys[k])];
    std::exclusive_scan(places.begin(), places.end(), places.begin(), int64_t(0));
    for (int64_t k = 0; k < all.count; ++k) {
      const int32_t number = all.order[k];
      sorted[places[digit(all.keys[number])]++] = number;
    }
    std::copy(sorted.get(), sorted.get() + all.count, all.order);
  }
}

template <class Problem>
void over_matrices(const Pool& pool, int64_t batch, const Problem& all, Kernel<Problem> kernel) {
  share_parts(pool, batch, all.particles, kMatrices,
              [&](int64_t m, int64_t first, int64_t last) { kernel(member(all, m), first, last); });
}

template <class T>
void run(const Pool& pool, int64_t batch, const Combine<T>& all) { add_up(pool, batch, all, kernels<T>().combine); }
template <class T>
void run(const Pool& pool, int64_t batch, const Product<T>& all) { add_up(pool, batch, all, kernels<T>().product); }
template <class T>
void run(const Pool& pool, int64_t batch, const Eigen<T>& all) { over_matrices(pool, batch, all, kernels<T>().eigen); }
template <class T>
void run(const Pool& pool, int64_t batch, const Rotation<T>& all) {
  over_matrices(pool, batch, all, kernels<T>().rotation);
}
inline void run(const Pool& pool, int64_t batch, const Order& all) {
  share(pool, batch, [&](int64_t m) { sort(member(all, m)); });
}

// Numbers of no particle are clipped where one is read, and dropped where one is written.
template <class T>
void run(const Pool& pool, int64_t batch, const Rearrangement<T>& all) {
  if (all.from == all.to && std::none_of(all.wanted, all.wanted + batch, [](bool one) { return one; })) return;
  share(pool, batch * all.rows, [&](int64_t i) {
    const Rearrangement<T> one = member(all, i / all.rows);
    const T* from = one.from + i % all.rows * all.count;
    T* to = one.to + i % all.rows * all.count;
    if (from != to) std::copy(from, from + all.count, to);
    if (!*one.wanted) return;
    const std::vector<T> before(from, from + all.count);
    for (int64_t k = 0, last = all.count - 1; k <= last; ++k) {
      const int64_t other = one.order[k], clipped = std::clamp<int64_t>(other, 0, last);
      if (!all.inverse) to[k] = before[clipped];
      if (all.inverse && other == clipped) to[other] = before[k];
    }
  });
}

}  // namespace mpmjax
