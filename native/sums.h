// The sums for a batch, on all threads.

#pragma once

#include "problems.h"
#include "share.h"

namespace mpmjax {

// d dimensions, s nodes along an axis, and whether it is the differential by the factors.
struct Form {
  int d;
  int s;
  bool differential;
};

// The stencils of the i-th member of a batch.
template <class T>
Stencils<T> member(Stencils<T> all, Form form, int64_t i) {
  if (all.places.first != nullptr) {
    Places<T>& places = all.places;
    places.first += i * form.d * all.particles, places.offset += i * form.d * all.particles;
    places.strides += i * form.d, places.polynomials += i * 2 * form.s * (form.s + 2);
    return all;
  }
  const int64_t factors = i * form.d * form.s * all.particles;
  all.index += factors;
  all.weights += factors;
  all.derivatives += factors;
  if (form.differential) {
    all.weight_changes += factors;
    all.derivative_changes += factors;
  }
  return all;
}

// Each returns false where there is no kernel of this form. `batch` problems follow each other in every array.
bool gather(const Pool& pool, Form form, int64_t batch, const Gather<float>& first);
bool gather(const Pool& pool, Form form, int64_t batch, const Gather<double>& first);
bool scatter(const Pool& pool, Form form, int64_t batch, const Scatter<float>& first);
bool scatter(const Pool& pool, Form form, int64_t batch, const Scatter<double>& first);
bool average(const Pool& pool, Form form, int64_t batch, const Average<float>& first);
bool average(const Pool& pool, Form form, int64_t batch, const Average<double>& first);
bool pull(const Pool& pool, Form form, int64_t batch, const Pull<float>& first);
bool pull(const Pool& pool, Form form, int64_t batch, const Pull<double>& first);
bool resist(const Pool& pool, Form form, int64_t batch, const Resist<float>& first);
bool resist(const Pool& pool, Form form, int64_t batch, const Resist<double>& first);

}  // namespace mpmjax
