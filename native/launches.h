// The sums of a batch as launches of threads that each do one particle or one node, on a card, or in tests one thread
// after the other on a CPU.
//
// `on.clear(numbers, count)` sets to zero, `on.launch(problem, kernel, all, columns, count, batch, run)` starts so many
// threads for each of a batch: of the kernel of this name, or run(d, s, columns, one, i).

#pragma once

#include "calls.h"
#include "one_thread.h"

namespace mpmjax {

// Vectors of up to four columns have code of their own.
template <class Problem>
int columns_of(const Problem& all) {
  return all.columns <= 4 ? static_cast<int>(all.columns) : 0;
}

template <class T, class On>
void gather(const On& on, int64_t batch, const Gather<T>& all) {
  on.launch("Gather", "gather", all, columns_of(all), all.stencils.particles, batch,
            [](auto d, auto s, auto c, const auto& one, int64_t p) { one_thread::gather<T, d, s, c>(one, p); });
}

template <class T, class On>
void scatter(const On& on, int64_t batch, const Scatter<T>& all) {
  on.clear(all.nodes, batch * all.size * all.columns);
  on.launch("Scatter", "scatter", all, columns_of(all), all.stencils.particles, batch,
            [](auto d, auto s, auto c, const auto& one, int64_t p) { one_thread::scatter<T, d, s, c>(one, p); });
}

template <class T, class On>
void average(const On& on, int64_t batch, const Average<T>& all) {
  scatter(on, batch, Scatter<T>{all.stencils, all.values, all.sums, nullptr, nullptr, all.size, all.columns, nullptr});
  on.launch("Average", "divide", all, 0, all.size, batch,
            [](auto d, auto s, auto c, const auto& one, int64_t i) { one_thread::divide<T, d, s, c>(one, i); });
}

template <class T, class On>
void pull(const On& on, int64_t batch, const Pull<T>& all) {
  on.launch("Pull", "pull", all, columns_of(all), all.stencils.particles, batch,
            [](auto d, auto s, auto c, const auto& one, int64_t p) { one_thread::pull<T, d, s, c>(one, p); });
  if (all.value == nullptr) return;
  gather(on, batch, Gather<T>{all.stencils, all.nodes, all.value, all.gradients, all.size, all.columns});
}

template <class T, class On>
void resist(const On& on, int64_t batch, const Resist<T>& all) {
  on.clear(all.nodes, batch * all.size * all.columns);
  on.launch("Resist", "resist", all, 0, all.stencils.particles, batch,
            [](auto d, auto s, auto c, const auto& one, int64_t p) { one_thread::resist<T, d, s, c>(one, p); });
}

}  // namespace mpmjax
