// Eigenvalues and eigenvectors of symmetric 3 x 3 matrices by Jacobi's cyclic method (G. H. Golub, C. F. Van Loan, Matrix
// Computations, 4th ed., 2013, section 8.5).

#pragma once

#include <limits>

#include "simd.h"
#include "matrices.h"

namespace {

constexpr int kSweeps = 4;  // the error squares in each

// One rotation of the method: component (p, q) of A becomes zero, and A = V A' Vᵀ stays the same matrix. Only the upper
// triangle is kept. Nothing is done where the component is negligible.
template <int p, int q, class V>
MPMJAX_INLINE void rotate(Matrix<V>& A, Matrix<V>& vectors, V negligible) {
  constexpr int r = 3 - p - q;
  const V one = V() + 1, gap = A.at[q][q] - A.at[p][p], twice = 2 * A.at[p][q];
  const V scale = magnitude(gap) + root(gap * gap + twice * twice);
  const V tan = magnitude(A.at[p][q]) <= negligible ? V() : (gap < 0 ? -twice : twice) / (scale == 0 ? one : scale);
  const V cos = one / root(one + tan * tan), sin = tan * cos;
  const auto turn = [&](V& a, V& b) MPMJAX_INLINE_LAMBDA {
    const V old = a;
    a = cos * old - sin * b;
    b = sin * old + cos * b;
  };
  A.at[p][p] -= tan * A.at[p][q];
  A.at[q][q] += tan * A.at[p][q];
  A.at[p][q] = V();
  turn(r < p ? A.at[r][p] : A.at[p][r], r < q ? A.at[r][q] : A.at[q][r]);
  each<3, true>([&](auto i) MPMJAX_INLINE_LAMBDA { turn(vectors.at[i][p], vectors.at[i][q]); });
}

template <class T>
void eigen(const mpmjax::Eigen<T>& task, int64_t first, int64_t last) {
  using V = Simd<T>;
  const V one = V() + 1, negligible = V() + std::numeric_limits<T>::epsilon() / 8;
  for (int64_t k = first; k < last; k += kSimdLanes<T>) {
    const Place<T> place(k, last, task.particles);
    Matrix<V> A, vectors;
    V size = {};  // the largest magnitude, of which squares could overflow
    upper_components([&](auto i, auto j) MPMJAX_INLINE_LAMBDA {
      A.at[i][j] = place.load(task.matrices, 3 * i + j);
      size = magnitude(A.at[i][j]) > size ? magnitude(A.at[i][j]) : size;
    });
    size = size == 0 ? one : size;
    upper_components([&](auto i, auto j) MPMJAX_INLINE_LAMBDA { A.at[i][j] /= size; });
    components([&](auto i, auto j) MPMJAX_INLINE_LAMBDA { vectors.at[i][j] = i == j ? one : V(); });
    for (int sweep = 0; sweep < kSweeps; ++sweep) {
      const auto rest = [&](const V& a) MPMJAX_INLINE_LAMBDA { return ~(magnitude(a) <= negligible); };
      if (!any(rest(A.at[0][1]) | rest(A.at[0][2]) | rest(A.at[1][2]))) break;
      rotate<0, 1>(A, vectors, negligible);
      rotate<0, 2>(A, vectors, negligible);
      rotate<1, 2>(A, vectors, negligible);
    }
    each<3, true>([&](auto i) MPMJAX_INLINE_LAMBDA { place.store(task.values, i, A.at[i][i] * size); });
    components([&](auto i, auto j) MPMJAX_INLINE_LAMBDA { place.store(task.vectors, 3 * i + j, vectors.at[i][j]); });
  }
}

}  // namespace
