// The slopes of a loss by the sums that an average was made of, from those by its results.

#pragma once

#include <cstdint>

#include "share.h"

namespace mpmjax {

// With whole weights M, means a, and slopes g by the means and h by the weights: g_k / M by each column of the sums, and
// h − Σ_k g_k a_k / M by the last. Zero where M is.
template <class T>
struct Slope {
  const T* whole;     // M, (n)
  const T* means;     // a, (n, c − 1)
  const T* by_means;  // g, (n, c − 1)
  const T* by_whole;  // h, (n), or null for zero
  T* by_sums;         // (n, c)
  int64_t size;
  int64_t columns;  // c
};

// `batch` problems follow each other in every array.
void slope(const Pool& pool, int64_t batch, const Slope<float>& first);
void slope(const Pool& pool, int64_t batch, const Slope<double>& first);

}  // namespace mpmjax
