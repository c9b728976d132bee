// A solve by the conjugate residual method with one matrix for each particle, as a whole.

#pragma once

#include "recurrence.h"

namespace mpmjax {

constexpr int kTolerances = 3, kOutcome = 9, kVectors = 6;

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

// Each returns false where there is no kernel of this form. `batch` problems follow each other in every array, and each
// ends by itself. As many as there are threads or more are shared among them whole, each with its arrays in the cache of
// one core; fewer are done one after the other by all threads.
bool solve(const Pool& pool, Form form, int64_t batch, const Solve<float>& first);
bool solve(const Pool& pool, Form form, int64_t batch, const Solve<double>& first);

}  // namespace mpmjax
