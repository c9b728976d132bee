// A solve by the conjugate residual method with one matrix for each particle, as a whole.

#pragma once

#include "problems.h"
#include "share.h"
#include "sums.h"

namespace mpmjax {

constexpr int kTolerances = 3, kOutcome = 9, kVectors = 6;
constexpr int kLimits = 4, kNumbers = 5;

// From x with the residual r: p = r + β p, q = W⁻¹A r + β q, x += α p, r −= α q, with A = M + χH on free components and
// the identity on others, H the resistance of the particles, and the sums of problems.h and vectors.h. It goes on while
// ‖r‖ is above the tolerance, ‖r‖² above the floor, steps are left, and rᵀA r does not vanish to rounding.
template <class T>
struct Recurrence {
  Stencils<T> stencils;
  const T* matrices;  // as in a resistance
  const T* mass;      // (n)
  const T* factor;    // χ
  const bool* free;   // (n, d), as all vectors
  const T* weight;    // W
  const bool* active;  // (⌈n d/64⌉), as in vectors.h
  const T* limits;  // tolerance of ‖r‖, floor of ‖r‖², most steps, ‖r‖² at the start
  T *x, *r;           // where it starts, and where it ends
  T *p, *q, *moved, *image;  // memory to work in; zero in `moved` wherever nothing is active
  T* numbers;  // ‖r‖², steps, largest |rᵀA r|/‖r‖², whether rᵀA r vanished, whether it was negative
  int64_t nodes, columns;
};

// H of what is in `moved`, into `image`.
template <class T>
Resist<T> resistance(const Recurrence<T>& of) {
  Resist<T> result = {};
  result.stencils = of.stencils, result.matrices = of.matrices, result.moved = of.moved, result.nodes = of.image;
  result.size = of.nodes, result.columns = of.columns, result.wanted = of.active;
  return result;
}

// The recurrence from `start`, and again from the true residual r = W⁻¹(b − A x) where it ends, until ‖r‖ is within its
// tolerance, has not halved, or steps are used up.
template <class T>
struct Solve {
  Recurrence<T> recurrence;  // of it A, W, x and where x starts
  const T* start;            // where x starts, which may lie where x does
  const T* rhs;              // W⁻¹b; zero wherever nothing is active
  const T* limits;           // ‖r‖/‖W⁻¹b‖ to reach; most steps; part of ‖r‖² at a start that is the recurrence's floor
  // ‖r‖², steps, largest |rᵀA r|/‖r‖², whether rᵀA r vanished, whether it was negative, the change of x by the last
  // recurrence, whether that has not halved ‖r‖, ‖W⁻¹b‖, and ‖x‖, all in the norm of W.
  T* numbers;
  T* memory;  // to work in, kVectors times the size of x; or null where each problem takes its own
};

// `batch` problems follow each other in every array, and each ends by itself. As many as there are threads or more are
// shared among them whole, each with its arrays in the cache of one core; fewer are done one by one by all threads.
template <class T>
void solve(const Pool& pool, Form form, int64_t batch, const Solve<T>& first);

}  // namespace mpmjax
