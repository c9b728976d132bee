#include "slope.h"

#include <algorithm>

#include "wipe.h"

namespace mpmjax {
namespace {

constexpr int64_t kPart = 1 << 14;  // nodes that a thread takes at a time

// Of nodes that have mass, all columns, or where `columns` is 0 any number of them.
template <class T, int columns>
void pull_back(const Slope<T>& task, int64_t first, int64_t last) {
  const int64_t c = columns == 0 ? task.columns : columns, others = c - 1;
  for (int64_t i = first; i < last; ++i) {
    const T whole = task.whole[i];
    T* to = task.by_sums + i * c;
    T by_whole = whole == 0 || task.by_whole == nullptr ? T(0) : task.by_whole[i];
    for (int64_t k = 0; k < others; ++k) {
      to[k] = whole == 0 ? T(0) : task.by_means[i * others + k] / whole;
      by_whole -= to[k] * task.means[i * others + k];
    }
    to[others] = by_whole;
  }
}

// Nodes from a first to before a last: those of a block of kTogether without mass become zero. Blocks that follow one
// another are set at once, for each stretch that is written past the caches waits for its end.
template <class T>
void pull_back(const Slope<T>& task, int64_t first, int64_t last) {
  int64_t empty = first;  // from here to i no node has mass
  const auto wipe_before = [&](int64_t i) {
    if (empty < i) wipe(task.by_sums, task.size * task.columns, empty * task.columns, i * task.columns);
  };
  for (int64_t end, i = first; i < last; i = end) {
    end = std::min(i + kTogether, last);
    if (std::all_of(task.whole + i, task.whole + end, [](T whole) { return whole == 0; })) continue;
    wipe_before(i);
    empty = end;
    switch (task.columns) {
      case 2: pull_back<T, 2>(task, i, end); break;
      case 3: pull_back<T, 3>(task, i, end); break;
      case 4: pull_back<T, 4>(task, i, end); break;
      default: pull_back<T, 0>(task, i, end);
    }
  }
  wipe_before(last);
}

template <class T>
void slope_all(const Pool& pool, int64_t batch, const Slope<T>& all) {
  const int64_t parts = std::max<int64_t>(1, (all.size + kPart - 1) / kPart), others = all.columns - 1;
  share(pool, batch * parts, [&](int64_t i) {
    const int64_t nodes = i / parts * all.size, first = i % parts * kPart;
    const Slope<T> task = {all.whole + nodes,
                           all.means + nodes * others,
                           all.by_means + nodes * others,
                           all.by_whole == nullptr ? nullptr : all.by_whole + nodes,
                           all.by_sums + nodes * all.columns,
                           all.size,
                           all.columns};
    pull_back(task, first, std::min(all.size, first + kPart));
  });
}

}  // namespace

void slope(const Pool& pool, int64_t batch, const Slope<float>& first) { slope_all(pool, batch, first); }
void slope(const Pool& pool, int64_t batch, const Slope<double>& first) { slope_all(pool, batch, first); }

}  // namespace mpmjax
