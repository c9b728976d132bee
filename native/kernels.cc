// All kernels for one instruction set, MPMJAX_TARGET, and one type of numbers, MPMJAX_NUMBER: each pair is compiled by
// itself, at the same time as others and in a part of the memory. Without a type, both.

#include "decompositions.h"
#include "kernels.h"
#include "passes.h"
#include "resist.h"

namespace {

using mpmjax::Kernels;

template <class T, int d, int s>
constexpr Kernels<T> sums_of = {{gather<T, d, s>, pull<T, d, s>, g2p<T, d, s>, scatter<T, d, s>, average<T, d, s>,
                                 p2g<T, d, s>, resist<T, d, s>},
                                find_ranges<T, d, s>};

template <template <class> class Problem, class T>
void decompose_lanes(const Problem<T>& task, int64_t first, int64_t last) {
  for (int64_t k = first; k < last; k += kSimdLanes<T>) decompose(task, ParticleLanes<T>(k, last, task.particles));
}

template <class T>
const Kernels<T>* sums(int d, int s) {
  static constexpr Kernels<T> table[][3] = {{sums_of<T, 1, 2>, sums_of<T, 1, 3>, sums_of<T, 1, 4>},
                                            {sums_of<T, 2, 2>, sums_of<T, 2, 3>, sums_of<T, 2, 4>},
                                            {sums_of<T, 3, 2>, sums_of<T, 3, 3>, sums_of<T, 3, 4>}};
  return &table[d - 1][s - 2];
}

}  // namespace

namespace mpmjax {

template <class Target, class T>
const KernelSet<T> Compiled<Target, T>::kernels = {sums<T>, decompose_lanes<Eigen, T>, decompose_lanes<Rotation, T>,
                                                    ::combine<T>, ::product<T>};

#if defined(MPMJAX_NUMBER)
template struct Compiled<MPMJAX_TARGET, MPMJAX_NUMBER>;
#else
template struct Compiled<MPMJAX_TARGET, float>;
template struct Compiled<MPMJAX_TARGET, double>;
#endif

}  // namespace mpmjax
