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
