// Vectors of a linear solve, combined in one pass.

#pragma once

#include <cstdint>

#include "problems.h"
#include "share.h"

namespace mpmjax {

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

// What is left of a product with A = M + χH on free components, once the force f = H v is known: the image y = W⁻¹A v, with
// (A v)_i = m_i v_i + χ f_i where i is free and v_i elsewhere, and Σ v (A v). Where `active` is false v is zero, and nothing
// free; the image is zero there if it is `whole`, and else left as it was. It may be where the force was.
template <class T>
struct Product {
  const T *force, *v;
  const T* mass;    // (nodes), each that of size/nodes components
  const T* factor;  // χ
  const bool* free;
  const T* weight;
  const bool* active;  // (⌈size/64⌉)
  T *image, *sum;
  int64_t size, nodes;
  bool whole;
};

// `batch` problems follow each other in every array. The sums have the same bits for any number of threads.
template <class T>
void combine(const Pool& pool, int64_t batch, const Combine<T>& first);
template <class T>
void product(const Pool& pool, int64_t batch, const Product<T>& first);

}  // namespace mpmjax
