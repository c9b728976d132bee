// Decompositions of 3 x 3 matrices, one or one in each lane: the eigenvalues and eigenvectors of symmetric ones, by
// Jacobi's cyclic method (G. H. Golub, C. F. Van Loan, Matrix Computations, 4th ed., 2013, section 8.5), and the
// rotation of the polar decomposition, as mpmjax/linalg/_decompositions.py writes it (N. J. Higham, V. Noferini, Numer.
// Algorithms 73 (2016) 349, doi 10.1007/s11075-016-0098-7).

#pragma once

#if defined(__CUDACC_RTC__)
#include "numbers.h"
#else
#include "vector.h"
#endif

namespace {

constexpr int kSweeps = 4;        // of Jacobi's method, the error squares in each
constexpr int kNewtonSteps = 30;  // on the quartic: halves the error at a double root, else squares it
constexpr int kPolishSteps = 2;   // on the rotation itself

template <class V>
MPMJAX_INLINE V magnitude(V x) {
  return x < 0 ? -x : x;
}

template <class V>
struct Matrix {
  V at[3][3];
};

// Calls f(i, j) for all components.
template <class F>
MPMJAX_INLINE void components(const F& f) {
  each<3>([&](auto i) MPMJAX_INLINE_LAMBDA { each<3>([&](auto j) MPMJAX_INLINE_LAMBDA { f(i, j); }); });
}

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
  each<3>([&](auto i) MPMJAX_INLINE_LAMBDA { turn(vectors.at[i][p], vectors.at[i][q]); });
}

// Reads and writes what `lanes` has of the matrices.
template <class T, class Lanes>
MPMJAX_INLINE void decompose(const mpmjax::Eigen<T>& task, const Lanes& lanes) {
  using V = typename Lanes::V;
  const V one = V() + 1, negligible = V() + T(sizeof(T) == 4 ? 0x1p-26 : 0x1p-55);  // an eighth of a rounding
  Matrix<V> A, vectors;
  V size = {};  // the largest magnitude, of which squares could overflow
  components([&](auto i, auto j) MPMJAX_INLINE_LAMBDA {
    A.at[i][j] = i <= j ? lanes.load(task.matrices, 3 * i + j) : V();
    size = magnitude(A.at[i][j]) > size ? magnitude(A.at[i][j]) : size;
  });
  size = size == 0 ? one : size;
  components([&](auto i, auto j) MPMJAX_INLINE_LAMBDA {
    A.at[i][j] /= size;
    vectors.at[i][j] = i == j ? one : V();
  });
  for (int sweep = 0; sweep < kSweeps; ++sweep) {
    const auto rest = [&](const V& a) MPMJAX_INLINE_LAMBDA { return (magnitude(a) <= negligible) == 0; };
    if (!any(rest(A.at[0][1]) | rest(A.at[0][2]) | rest(A.at[1][2]))) break;
    rotate<0, 1>(A, vectors, negligible);
    rotate<0, 2>(A, vectors, negligible);
    rotate<1, 2>(A, vectors, negligible);
  }
  each<3>([&](auto i) MPMJAX_INLINE_LAMBDA { lanes.store(task.values, i, A.at[i][i] * size); });
  components([&](auto i, auto j) MPMJAX_INLINE_LAMBDA { lanes.store(task.vectors, 3 * i + j, vectors.at[i][j]); });
}

template <class V>
struct Quaternion {
  V at[4];
};

template <class V>
MPMJAX_INLINE V cofactor(const Matrix<V>& A, int i, int j) {
  const int i1 = (i + 1) % 3, i2 = (i + 2) % 3, j1 = (j + 1) % 3, j2 = (j + 2) % 3;
  return A.at[i1][j1] * A.at[i2][j2] - A.at[i1][j2] * A.at[i2][j1];
}

template <class V>
MPMJAX_INLINE V determinant(const Matrix<V>& A) {
  return A.at[0][0] * cofactor(A, 0, 0) + A.at[0][1] * cofactor(A, 0, 1) + A.at[0][2] * cofactor(A, 0, 2);
}

// Σ f(i, j) over all components.
template <class V, class F>
MPMJAX_INLINE V total(const F& f) {
  V sum = {};
  components([&](auto i, auto j) MPMJAX_INLINE_LAMBDA { sum += f(i, j); });
  return sum;
}

// tr S for ‖F‖ = 1, by Newton's method from √3 ≥ tr S, from where it falls until rounding. A lane that no longer falls
// has ended, whatever others do.
template <class V>
MPMJAX_INLINE V largest_root(const Matrix<V>& F) {
  const V J = determinant(F), one = V() + 1;
  const V squares = total<V>([&](auto i, auto j) MPMJAX_INLINE_LAMBDA { return cofactor(F, i, j) * cofactor(F, i, j); });
  V result = root(V() + 3);
  for (int step = 0; step < kNewtonSteps; ++step) {
    const V square = result * result - one, slope = 4 * result * square - 8 * J;
    const V lower = result - (square * square - 8 * J * result - 4 * squares) / (slope == 0 ? one : slope);
    const auto falls = lower < result;
    if (!any(falls)) break;
    result = falls ? lower : result;
  }
  return result;
}

template <class V>
MPMJAX_INLINE void normalise(Quaternion<V>& q) {
  const V one = V() + 1;
  const V size = root(q.at[0] * q.at[0] + q.at[1] * q.at[1] + q.at[2] * q.at[2] + q.at[3] * q.at[3]);
  const auto nothing = size == 0;
  const V scale = nothing ? one : size;
  each<4>([&](auto i) MPMJAX_INLINE_LAMBDA { q.at[i] /= scale; });
  q.at[0] = nothing ? one : q.at[0];
}

// The determinant of what K has left without row i and column j, with its sign.
template <int i, int j, class V>
MPMJAX_INLINE V signed_minor(const V (&K)[4][4]) {
  Matrix<V> left;
  components([&](auto r, auto c) MPMJAX_INLINE_LAMBDA { left.at[r][c] = K[r + (r >= i)][c + (c >= j)]; });
  return (i + j) % 2 == 0 ? determinant(left) : -determinant(left);
}

// The unit quaternion that maximises tr(RᵀF) = qᵀ K q: the largest column of adj(K − λI), λ the largest root.
template <class V>
MPMJAX_INLINE Quaternion<V> dominant_quaternion(const Matrix<V>& F, V largest) {
  const V trace = F.at[0][0] + F.at[1][1] + F.at[2][2];
  const V z[3] = {F.at[2][1] - F.at[1][2], F.at[0][2] - F.at[2][0], F.at[1][0] - F.at[0][1]};
  V K[4][4];
  K[0][0] = trace - largest;
  each<3>([&](auto i) MPMJAX_INLINE_LAMBDA { K[0][i + 1] = K[i + 1][0] = z[i]; });
  components([&](auto i, auto j) MPMJAX_INLINE_LAMBDA {
    const V sum = F.at[i][j] + F.at[j][i];
    K[i + 1][j + 1] = i == j ? sum - trace - largest : sum;
  });
  V adjoint[4][4];
  each<4>([&](auto i) MPMJAX_INLINE_LAMBDA {
    each<4>([&](auto j) MPMJAX_INLINE_LAMBDA {
      constexpr int row = decltype(i)::value, column = decltype(j)::value;
      if constexpr (column >= row) adjoint[row][column] = signed_minor<row, column>(K);
      if constexpr (column < row) adjoint[row][column] = adjoint[column][row];
    });
  });
  Quaternion<V> q = {{adjoint[0][0], adjoint[0][1], adjoint[0][2], adjoint[0][3]}};
  V size = magnitude(adjoint[0][0]);
  each<3>([&](auto other) MPMJAX_INLINE_LAMBDA {
    constexpr int j = other + 1;
    const auto larger = magnitude(adjoint[j][j]) > size;
    each<4>([&](auto i) MPMJAX_INLINE_LAMBDA { q.at[i] = larger ? adjoint[j][i] : q.at[i]; });
    size = larger ? magnitude(adjoint[j][j]) : size;
  });
  normalise(q);
  return q;
}

template <class V>
MPMJAX_INLINE Matrix<V> rotation_of(const Quaternion<V>& q) {
  const V w = q.at[0], x = q.at[1], y = q.at[2], z = q.at[3], one = V() + 1;
  return {{{one - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
           {2 * (x * y + w * z), one - 2 * (x * x + z * z), 2 * (y * z - w * x)},
           {2 * (x * z - w * y), 2 * (y * z + w * x), one - 2 * (x * x + y * y)}}};
}

// A step of Newton's method on q: by half the spin ω with (tr(S) I − S) ω = vee(S − Sᵀ), S = RᵀF.
template <class V>
MPMJAX_INLINE void polish(Quaternion<V>& q, const Matrix<V>& F) {
  const Matrix<V> R = rotation_of(q);
  Matrix<V> S, system;
  components([&](auto i, auto j) MPMJAX_INLINE_LAMBDA {
    S.at[i][j] = R.at[0][i] * F.at[0][j] + R.at[1][i] * F.at[1][j] + R.at[2][i] * F.at[2][j];
  });
  const V trace = S.at[0][0] + S.at[1][1] + S.at[2][2];
  components([&](auto i, auto j) MPMJAX_INLINE_LAMBDA { system.at[i][j] = i == j ? trace - S.at[i][j] : -S.at[i][j]; });
  const V v[3] = {S.at[2][1] - S.at[1][2], S.at[0][2] - S.at[2][0], S.at[1][0] - S.at[0][1]};
  const V det = determinant(system);
  V spin[3];
  each<3>([&](auto i) MPMJAX_INLINE_LAMBDA {
    spin[i] = (cofactor(system, 0, i) * v[0] + cofactor(system, 1, i) * v[1] + cofactor(system, 2, i) * v[2]) / det;
  });
  const V w = q.at[0], x = q.at[1], y = q.at[2], z = q.at[3], a = spin[0], b = spin[1], c = spin[2];
  const V turned[4] = {-x * a - y * b - z * c, w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a};
  const auto near = 10 * (a * a + b * b + c * c) < 1;  // else R is hardly known
  each<4>([&](auto i) MPMJAX_INLINE_LAMBDA { q.at[i] = near ? q.at[i] + turned[i] / 2 : q.at[i]; });
  normalise(q);
}

template <class T, class Lanes>
MPMJAX_INLINE void decompose(const mpmjax::Rotation<T>& task, const Lanes& lanes) {
  using V = typename Lanes::V;
  Matrix<V> F;
  components([&](auto i, auto j) MPMJAX_INLINE_LAMBDA { F.at[i][j] = lanes.load(task.matrices, 3 * i + j); });
  const V norm = root(total<V>([&](auto i, auto j) MPMJAX_INLINE_LAMBDA { return F.at[i][j] * F.at[i][j]; }));
  const V size = norm == 0 ? V() + 1 : norm;
  components([&](auto i, auto j) MPMJAX_INLINE_LAMBDA { F.at[i][j] /= size; });
  Quaternion<V> q = dominant_quaternion(F, largest_root(F));
  for (int step = 0; step < kPolishSteps; ++step) polish(q, F);
  const Matrix<V> R = rotation_of(q);
  components([&](auto i, auto j) MPMJAX_INLINE_LAMBDA { lanes.store(task.rotations, 3 * i + j, R.at[i][j]); });
}

}  // namespace
