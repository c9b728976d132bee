// Vectors of a linear solve, combined in one pass.

#pragma once

#include <cstdint>

#include "share.h"

namespace mpmjax {

constexpr int64_t kTogether = 64;  // numbers that are passed over together

// y = a + s_0 b, z = c + s_1 d and Σ w z². Where `active` is false, all of a, b, c and d are zero. A result may be what one
// of its two vectors was.
template <class T>
struct Combine {
  const T *a, *b, *c, *d;
  const T* scales;  // s_0, s_1
  const T* weight;
  const bool* active;  // (⌈size/64⌉)
  T *y, *z, *sum;
  int64_t size;
};

// `batch` problems follow each other in every array. The sums have the same bits for any number of threads.
void combine(const Pool& pool, int64_t batch, const Combine<float>& first);
void combine(const Pool& pool, int64_t batch, const Combine<double>& first);

}  // namespace mpmjax
