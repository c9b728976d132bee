// The sums for a batch, on all threads.

#pragma once

#include <vector>

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

// The nodes of each member cut into parts, one for each thread, and the ranges of nodes that its blocks of particles
// reach. Where there is one part there are none, unless they are wanted.
struct Division {
  int64_t parts, blocks;
  std::vector<Range> ranges;
  std::vector<std::vector<int64_t>> cuts;
};

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

// The division of a resistance, which its particles' places alone decide, and the resistance with a division found before.
Division divided(const Pool& pool, Form form, int64_t batch, const Resist<float>& first);
Division divided(const Pool& pool, Form form, int64_t batch, const Resist<double>& first);
bool resist(const Pool& pool, Form form, int64_t batch, const Resist<float>& first, const Division& division);
bool resist(const Pool& pool, Form form, int64_t batch, const Resist<double>& first, const Division& division);

}  // namespace mpmjax
