// The average: m_i, the last column of a scatter, and its other columns divided by m_i, where m_i is more than a least.
//
// Blocks of nodes that no particle reaches are set to zero and not looked at.

#pragma once

#include "scatter.h"

namespace {

using mpmjax::Average;

// Of nodes from a first to before a last, all columns, or where `columns` is 0 any number of them.
template <class T, int columns>
void divide(const Average<T>& task, int64_t first, int64_t last) {
  const int64_t c = columns == 0 ? task.columns : columns, others = c - 1;
  const T least = task.least[0];
  for (int64_t i = first; i < last; ++i) {
    const T* sums = task.sums + i * c;
    const bool some = sums[others] > least;
    const T whole = some ? sums[others] : T(1);
    task.whole[i] = some ? whole : T(0);
    for (int64_t k = 0; k < others; ++k) task.means[i * others + k] = some ? sums[k] / whole : T(0);
  }
}

template <class T>
void divide_all(const Average<T>& task, int64_t first, int64_t last) {
  switch (task.columns) {
    case 2: return divide<T, 2>(task, first, last);
    case 3: return divide<T, 3>(task, first, last);
    case 4: return divide<T, 4>(task, first, last);
    default: return divide<T, 0>(task, first, last);
  }
}

template <class T, int d, int s>
void average(const Average<T>& task, int64_t first, int64_t last) {
  const int64_t columns = task.columns, others = columns - 1;
  if (task.reached != nullptr) mark<T, d, s>(task.stencils, task.ranges, task.reached, first, last);
  over_reached(task.reached, first, last, [&](bool reached, int64_t from, int64_t to) {
    if (reached) {
      clear(task.sums, nullptr, from * columns, to * columns);
    } else {
      wipe(task.whole, task.size, from, to);
      wipe(task.means, task.size * others, from * others, to * others);
    }
  });
  const Scatter<T> sums = {task.stencils, task.values, task.sums, task.ranges, nullptr, task.size, columns, nullptr};
  add_all<T, d, s>(sums, first, last);
  over_reached(task.reached, first, last, [&](bool reached, int64_t from, int64_t to) {
    if (reached) divide_all(task, from, to);
  });
}

}  // namespace
