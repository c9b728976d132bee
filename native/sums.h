// The sums for a batch, on all threads.

#pragma once

#include <vector>

#include "problems.h"
#include "share.h"

namespace mpmjax {

// d dimensions, and s nodes along an axis.
struct Form {
  int d;
  int s;
};

// The stencils of the i-th member of a batch.
template <class T>
Stencils<T> member(Stencils<T> all, Form form, int64_t i) {
  const int64_t places = i * form.d * all.particles;
  all.first += places, all.offset += places;
  if (all.change != nullptr) all.change += places;
  return all;
}

// The nodes of each member cut into parts, one for each thread, and the ranges of nodes that its blocks of particles
// reach. Where there is one part there are none, unless they are wanted.
struct Division {
  int64_t parts, blocks;
  std::vector<Range> ranges;
  std::vector<std::vector<int64_t>> cuts;
};

// Of float and double. `batch` problems follow each other in every array. There are kernels of one to three dimensions and
// two to four nodes.
template <class T>
void gather(const Pool& pool, Form form, int64_t batch, const Gather<T>& first);
template <class T>
void scatter(const Pool& pool, Form form, int64_t batch, const Scatter<T>& first);
template <class T>
void average(const Pool& pool, Form form, int64_t batch, const Average<T>& first);
template <class T>
void pull(const Pool& pool, Form form, int64_t batch, const Pull<T>& first);

// The division of a resistance, which its particles' places alone decide, and the resistance with one found before.
template <class T>
Division divided(const Pool& pool, Form form, int64_t batch, const Resist<T>& first);
template <class T>
void resist(const Pool& pool, Form form, int64_t batch, const Resist<T>& first, const Division& division);

}  // namespace mpmjax
