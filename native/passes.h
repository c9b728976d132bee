// What is done to the blocks of vectors from a first to a last: two combinations, what is left of a product, and the
// sums that follow.

#pragma once

#include <algorithm>
#include <cstring>

#include "problems.h"

namespace {

using mpmjax::kChunk;

template <class T>
void reset(T* result, const T* one, const T* other, int64_t first, int64_t count) {
  if (result != one && result != other) std::memset(result + first, 0, static_cast<size_t>(count) * sizeof(T));
}

// A sum in double, which hardly depends on the order of its terms: eight sums side by side, that one needs not wait for
// another.
class Sum {
 public:
  // Calls term(i) for i from zero to count, at most kChunk.
  template <class Term>
  void add(int64_t count, const Term& term) {
    double terms[kChunk] = {};
    for (int64_t i = 0; i < count; ++i) terms[i] = term(i);
    for (int64_t i = 0; i < kChunk; i += kPartialSums) {
      for (int64_t k = 0; k < kPartialSums; ++k) sums_[k] += terms[i + k];
    }
  }

  double total() const {
    double total = 0;
    for (const double sum : sums_) total += sum;
    return total;
  }

 private:
  static constexpr int64_t kPartialSums = 8;
  double sums_[kPartialSums] = {};
};

template <class T>
double combine(const mpmjax::Combine<T>& task, int64_t first, int64_t last) {
  const T s = task.scales[0], t = task.scales[1];
  Sum sum;
  for (int64_t k = first; k < last; ++k) {
    const int64_t start = k * kChunk, count = std::min(kChunk, task.size - start);
    if (!task.active[k]) {
      reset(task.y, task.a, task.b, start, count);
      reset(task.z, task.c, task.d, start, count);
      continue;
    }
    T y[kChunk], z[kChunk];  // the results may lie where the vectors are
    for (int64_t i = 0; i < count; ++i) y[i] = task.a[start + i] + s * task.b[start + i];
    for (int64_t i = 0; i < count; ++i) z[i] = task.c[start + i] + t * task.d[start + i];
    sum.add(count, [&](int64_t i) { return static_cast<double>(task.weight[start + i] * z[i]) * z[i]; });
    std::memcpy(task.y + start, y, static_cast<size_t>(count) * sizeof(T));
    std::memcpy(task.z + start, z, static_cast<size_t>(count) * sizeof(T));
  }
  return sum.total();
}

template <class T>
double product(const mpmjax::Product<T>& task, int64_t first, int64_t last) {
  const T factor = task.factor[0];
  const int64_t each = task.nodes > 0 ? task.size / task.nodes : 1;
  Sum sum;
  for (int64_t k = first; k < last; ++k) {
    const int64_t start = k * kChunk, count = std::min(kChunk, task.size - start);
    if (!task.active[k]) {
      if (task.whole) std::memset(task.image + start, 0, static_cast<size_t>(count) * sizeof(T));
      continue;
    }
    T mass[kChunk], image[kChunk];  // the image may lie where the force is
    for (int64_t i = 0, node = start / each, part = start % each; i < count; ++i) {
      mass[i] = task.mass[node];
      if (++part == each) part = 0, ++node;
    }
    for (int64_t i = 0; i < count; ++i) {
      const T v = task.v[start + i], pushed = mass[i] * v + factor * task.force[start + i];
      image[i] = task.free[start + i] ? pushed : v;
    }
    sum.add(count, [&](int64_t i) { return static_cast<double>(task.v[start + i]) * image[i]; });
    for (int64_t i = 0; i < count; ++i) task.image[start + i] = image[i] / task.weight[start + i];
  }
  return sum.total();
}

}  // namespace
