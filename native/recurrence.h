// The recurrence of the conjugate residual method with one matrix for each particle.

#pragma once

#include "problems.h"
#include "share.h"
#include "sums.h"

namespace mpmjax {

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
  Resist<T> found = {};
  found.stencils = of.stencils, found.matrices = of.matrices, found.moved = of.moved, found.nodes = of.image;
  found.size = of.nodes, found.columns = of.columns, found.wanted = of.active;
  return found;
}

// Each returns false where there is no kernel of this form. The division is that of the resistance.
bool recur(const Pool& pool, Form form, const Recurrence<float>& task, const Division& division);
bool recur(const Pool& pool, Form form, const Recurrence<double>& task, const Division& division);

}  // namespace mpmjax
