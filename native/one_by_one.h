// The kernels of one_thread.h on a CPU, one thread after the other.

#pragma once

#include <cstring>
#include <type_traits>

#include "launches.h"

namespace mpmjax {

// Calls run(constant) for a number from a first to before a last.
template <int first, int last, class Run>
void with_constant(int n, const Run& run) {
  if constexpr (first < last) {
    if (n == first) return run(std::integral_constant<int, first>());
    with_constant<first + 1, last>(n, run);
  }
}

// Vectors of up to so many columns are summed by code of their own.
template <int most_columns>
struct OneByOne {
  template <class T>
  void clear(T* numbers, int64_t count) const {
    std::memset(numbers, 0, count * sizeof(T));
  }

  template <class Problem>
  void launch(const char*, const Problem& all, const Shape& shape, int64_t count, int64_t batch) const {
    with_constant<1, 4>(shape.d, [&](auto d) {
      with_constant<2, 5>(shape.s, [&](auto s) {
        with_constant<0, most_columns + 1>(shape.columns > most_columns ? 0 : shape.columns, [&](auto c) {
          for (int64_t i = 0; i < count * batch; ++i) one_thread::run<d, s, c>(member(all, i / count), i % count);
        });
      });
    });
  }

  template <class Problem>
  void launch(const char*, const Problem& all, int64_t count, int64_t batch) const {
    for (int64_t i = 0; i < count * batch; ++i) one_thread::run<0, 0, 0>(member(all, i / count), i % count);
  }
};

}  // namespace mpmjax
