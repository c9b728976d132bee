#include "order.h"

#include <algorithm>
#include <array>
#include <memory>

namespace mpmjax {
namespace {

constexpr int kBits = 11;  // of a digit: its counts stay in the nearest cache
constexpr uint32_t kDigits = 1u << kBits;

// A counting sort by one digit after the other, the last digit first. Digits in which no two keys differ are passed over.
void sort(const Order& all) {
  if (all.count == 0) return;
  const auto [least, most] = std::minmax_element(all.keys, all.keys + all.count);
  const uint32_t base = static_cast<uint32_t>(*least), reach = static_cast<uint32_t>(*most) - base;
  for (int64_t k = 0; k < all.count; ++k) all.order[k] = static_cast<int32_t>(k);
  const std::unique_ptr<int32_t[]> sorted(new int32_t[all.count]);
  for (int shift = 0; shift < 32 && reach >> shift != 0; shift += kBits) {
    const auto digit = [&](int32_t key) { return ((static_cast<uint32_t>(key) - base) >> shift) % kDigits; };
    std::array<int64_t, kDigits> places = {};
    for (int64_t k = 0; k < all.count; ++k) ++places[digit(all.keys[k])];
    int64_t place = 0;
    for (int64_t& one : places) {
      const int64_t result = one;
      one = place;
      place += result;
    }
    for (int64_t k = 0; k < all.count; ++k) {
      const int32_t number = all.order[k];
      sorted[places[digit(all.keys[number])]++] = number;
    }
    std::copy(sorted.get(), sorted.get() + all.count, all.order);
  }
}

// One row. Numbers of no particle are clipped where one is read, and dropped where one is written.
template <class T>
void rearrange_row(const Rearrangement<T>& all, const T* from, T* to) {
  const int64_t last = all.count - 1;
  for (int64_t k = 0; k <= last; ++k) {
    const int64_t other = all.order[k];
    if (!all.inverse) {
      to[k] = from[std::clamp<int64_t>(other, 0, last)];
    } else if (other >= 0 && other <= last) {
      to[other] = from[k];
    }
  }
}

}  // namespace

template <class T>
void rearrange(const Pool& pool, int64_t batch, const Rearrangement<T>& all) {
  const int64_t size = all.rows * all.count;
  if (all.from == all.to && std::none_of(all.wanted, all.wanted + batch, [](bool one) { return one; })) return;
  share(pool, batch * all.rows, [&](int64_t i) {
    const int64_t m = i / all.rows;
    Rearrangement<T> one = all;
    one.order += m * all.count;
    const T* from = all.from + m * size + i % all.rows * all.count;
    T* to = all.to + m * size + i % all.rows * all.count;
    if (from != to) std::copy(from, from + all.count, to);
    if (!all.wanted[m]) return;
    const std::unique_ptr<T[]> before(new T[all.count]);
    std::copy(from, from + all.count, before.get());
    rearrange_row(one, before.get(), to);
  });
}

template void rearrange(const Pool&, int64_t, const Rearrangement<float>&);
template void rearrange(const Pool&, int64_t, const Rearrangement<double>&);

void order(const Pool& pool, int64_t batch, const Order& first) {
  share(pool, batch, [&](int64_t m) { sort({first.keys + m * first.count, first.order + m * first.count, first.count}); });
}

}  // namespace mpmjax
