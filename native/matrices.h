// Decompositions of 3 x 3 matrices, one for each particle: what JAX makes slow loops of.

#pragma once

#include <cstdint>

#include "share.h"

namespace mpmjax {

// S = V diag(w) Vᵀ of symmetric S, of which only the upper triangle is read. Eigenvalues have no order, det V = 1.
template <class T>
struct Eigen {
  const T* matrices;  // S, (3, 3, p)
  T* values;          // w, (3, p)
  T* vectors;         // V, (3, 3, p)
  int64_t particles;
};

// The rotation R of F = R S, which maximises tr(RᵀF).
template <class T>
struct Rotation {
  const T* matrices;  // F, (3, 3, p)
  T* rotations;       // R, (3, 3, p)
  int64_t particles;
};

// `batch` problems follow each other in every array.
template <class T>
void eigen(const Pool& pool, int64_t batch, const Eigen<T>& first);
template <class T>
void rotation(const Pool& pool, int64_t batch, const Rotation<T>& first);

}  // namespace mpmjax
