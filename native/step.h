// What particles give to the nodes in P2G and take from them in G2P. `read(array, row)` is a row of an array (..., p).

#pragma once

#include "numbers.h"

namespace {

// Calls put(row, numbers) for the value, row 0, and then the gradient along each axis: d numbers, and the mass or zero.
// `offset(b)` is that of the particle along an axis.
template <int d, int s, class V, class T, class Offset, class Read, class Put>
MPMJAX_INLINE void put_rows(const mpmjax::P2G<T>& task, const Offset& offset, const Read& read, const Put& put) {
  const T spacing = 1 / task.slope[0], factor = task.factor[0] * task.slope[0];
  const V m = read(task.mass, 0);
  V given[mpmjax::kMostAxes + 1] = {};
  MPMJAX_UNROLL for (int r = 0; r < d; ++r) {
    given[r] = m * (read(task.v, r) + (task.push == nullptr ? T(0) : task.push[r]));
  }
  given[d] = m;
  put(0, given);
  given[d] = V{};
  const V q = task.q == nullptr ? V{} : factor * read(task.q, 0);
  const V isotropic = task.r == nullptr ? V{} : factor * read(task.r, 0);
  V A[d][d], B[d][d], C[d][d];
  MPMJAX_UNROLL for (int r = 0; r < d; ++r) {
    MPMJAX_UNROLL for (int b = 0; b < d; ++b) {
      C[r][b] = task.C == nullptr ? V{} : m * read(task.C, d * r + b);
      B[r][b] = task.B == nullptr ? V{} : read(task.B, d * r + b);
      A[r][b] = task.A == nullptr ? q * B[r][b] : factor * read(task.A, d * r + b);
    }
  }
  MPMJAX_UNROLL for (int b = 0; b < d; ++b) {
    V moment = V{} + (s == 3 ? T(1) / 4 : T(1) / 3);
    if (s == 2) moment = T(0.25) - offset(b) * offset(b);
    MPMJAX_UNROLL for (int r = 0; r < d; ++r) {
      given[r] = spacing * moment * C[r][b];
      if (task.A != nullptr && task.B == nullptr) given[r] += A[r][b];
      MPMJAX_UNROLL for (int l = 0; l < d; ++l) {
        if (task.B != nullptr) given[r] += A[r][l] * B[b][l];
      }
    }
    given[b] += isotropic;
    put(b + 1, given);
  }
}

// Moves particles by the velocity and its gradients in spacings, of which `gradients[b][r]` is that of component r along
// axis b. `write(array, row, numbers)` may write where it is read.
template <int d, class V, class T, class Gradients, class Read, class Write>
MPMJAX_INLINE void move(const mpmjax::G2P<T>& task, const V* value, const Gradients& gradients, const Read& read,
                        const Write& write) {
  const T slope = task.slope[0], dt = task.dt[0];
  V gradient[d][d];
  MPMJAX_UNROLL for (int r = 0; r < d; ++r) {
    write(task.value, r, value[r]);
    write(task.moved, r, read(task.x, r) + dt * value[r]);
    MPMJAX_UNROLL for (int b = 0; b < d; ++b) {
      gradient[r][b] = slope * gradients[b][r];
      write(task.gradient, d * r + b, gradient[r][b]);
    }
  }
  if (task.F == nullptr) return;
  MPMJAX_UNROLL for (int c = 0; c < d; ++c) {
    V column[d];
    MPMJAX_UNROLL for (int k = 0; k < d; ++k) column[k] = read(task.F, d * k + c);
    MPMJAX_UNROLL for (int r = 0; r < d; ++r) {
      V change = {};
      MPMJAX_UNROLL for (int k = 0; k < d; ++k) change += gradient[r][k] * column[k];
      write(task.strained, d * r + c, column[r] + dt * change);
    }
  }
}

}  // namespace
