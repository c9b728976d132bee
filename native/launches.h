// Problems of a batch as launches of threads that each do one particle or one node, on a card, or in checks one thread
// after the other on a CPU.
//
// `on.clear(numbers, count)` sets to zero, `on.launch(name, all, shape, count, batch)` calls one_thread::run for each of
// so many particles or nodes of each member of a problem of this name, which has a shape where it takes sums.

#pragma once

#include "one_thread.h"

namespace mpmjax {

// Constants of a kernel.
struct Shape {
  int d = 0, s = 0, columns = 0, terms = 0;
};

// Vectors of up to four columns have code of their own.
template <class Problem>
Shape shape_of(const Problem& all) {
  const auto& basis = all.stencils.basis;
  return {basis.d, basis.s, all.columns <= 4 ? static_cast<int>(all.columns) : 0, basis.terms};
}

template <class T, class On>
void run(const On& on, int64_t batch, const Gather<T>& all) {
  on.launch("Gather", all, shape_of(all), all.stencils.particles, batch);
}

template <class T, class On>
void run(const On& on, int64_t batch, const Scatter<T>& all) {
  on.clear(all.nodes, batch * all.size * all.columns);
  on.launch("Scatter", all, shape_of(all), all.stencils.particles, batch);
}

template <class T, class On>
void run(const On& on, int64_t batch, const Average<T>& all) {
  run(on, batch, Scatter<T>{all.stencils, all.values, all.sums, nullptr, nullptr, all.size, all.columns, nullptr});
  on.launch("Average", all, all.size, batch);
}

template <class T, class On>
void run(const On& on, int64_t batch, const P2G<T>& all) {
  on.clear(all.sums, batch * all.size * all.columns);
  on.launch("P2G", all, shape_of(all), all.stencils.particles, batch);
  const Average<T> means = {all.stencils, {}, all.least, all.whole, all.means, all.sums, nullptr, nullptr, all.size,
                            all.columns};
  on.launch("Average", means, all.size, batch);
}

template <class T, class On>
void run(const On& on, int64_t batch, const G2P<T>& all) {
  on.launch("G2P", all, shape_of(all), all.stencils.particles, batch);
}

template <class T, class On>
void run(const On& on, int64_t batch, const Pull<T>& all) {
  on.launch("Pull", all, shape_of(all), all.stencils.particles, batch);
  if (all.value == nullptr) return;
  run(on, batch, Gather<T>{all.stencils, all.nodes, all.value, all.gradients, all.size, all.columns});
}

template <class T, class On>
void run(const On& on, int64_t batch, const Resist<T>& all) {
  on.clear(all.nodes, batch * all.size * all.columns);
  on.launch("Resist", all, shape_of(all), all.stencils.particles, batch);
}

template <class T, class On>
void run(const On& on, int64_t batch, const Eigen<T>& all) {
  on.launch("Eigen", all, all.particles, batch);
}

template <class T, class On>
void run(const On& on, int64_t batch, const Rotation<T>& all) {
  on.launch("Rotation", all, all.particles, batch);
}

}  // namespace mpmjax
