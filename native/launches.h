// The sums of a batch as launches of threads that each do one particle or one node, on a card, or in checks one thread
// after the other on a CPU.
//
// `on.clear(numbers, count)` sets to zero, `on.launch(name, all, columns, count, batch)` calls one_thread::run for each
// of so many particles or nodes of each member of a problem of this name.

#pragma once

#include "one_thread.h"

namespace mpmjax {

// Vectors of up to four columns have code of their own.
template <class Problem>
int columns_of(const Problem& all) {
  return all.columns <= 4 ? static_cast<int>(all.columns) : 0;
}

template <class T, class On>
void run(const On& on, int64_t batch, const Gather<T>& all) {
  on.launch("Gather", all, columns_of(all), all.stencils.particles, batch);
}

template <class T, class On>
void run(const On& on, int64_t batch, const Scatter<T>& all) {
  on.clear(all.nodes, batch * all.size * all.columns);
  on.launch("Scatter", all, columns_of(all), all.stencils.particles, batch);
}

template <class T, class On>
void run(const On& on, int64_t batch, const Average<T>& all) {
  run(on, batch, Scatter<T>{all.stencils, all.values, all.sums, nullptr, nullptr, all.size, all.columns, nullptr});
  on.launch("Average", all, 0, all.size, batch);
}

template <class T, class On>
void run(const On& on, int64_t batch, const Pull<T>& all) {
  on.launch("Pull", all, columns_of(all), all.stencils.particles, batch);
  if (all.value == nullptr) return;
  run(on, batch, Gather<T>{all.stencils, all.nodes, all.value, all.gradients, all.size, all.columns});
}

template <class T, class On>
void run(const On& on, int64_t batch, const Resist<T>& all) {
  on.clear(all.nodes, batch * all.size * all.columns);
  on.launch("Resist", all, 0, all.stencils.particles, batch);
}

}  // namespace mpmjax
