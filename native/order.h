// The order of numbers, and numbers of particles in another order.

#pragma once

#include <cstdint>

#include "share.h"

namespace mpmjax {

// The order of numbers from the least to the largest, where equal ones keep theirs.
struct Order {
  const int32_t* keys;  // (p,), any numbers
  int32_t* order;       // (p,): the number of the key that is the least, of the next one, ...
  int64_t count;
};

// Numbers of particles in another order of these, or as they are where it is not wanted. They may come from and go to the
// same memory.
template <class T>
struct Rearrangement {
  const bool* wanted;    // one
  const int32_t* order;  // (p,): what comes k-th is of particle order[k]; with `inverse` what comes order[k]-th of the k-th
  const T* from;         // (c, p)
  T* to;
  int64_t rows, count;  // c and p
  bool inverse;
};

// `batch` problems follow each other in every array.
void order(const Pool& pool, int64_t batch, const Order& first);
template <class T>
void rearrange(const Pool& pool, int64_t batch, const Rearrangement<T>& first);

}  // namespace mpmjax
