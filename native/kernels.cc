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

template <class T>
const Kernels<T>* sums(int d, int s) {
  static constexpr Kernels<T> table[][3] = {{sums_of<T, 1, 2>, sums_of<T, 1, 3>, sums_of<T, 1, 4>},
                                            {sums_of<T, 2, 2>, sums_of<T, 2, 3>, sums_of<T, 2, 4>},
                                            {sums_of<T, 3, 2>, sums_of<T, 3, 3>, sums_of<T, 3, 4>}};
  return &table[d - 1][s - 2];
}

}  // namespace

namespace mpmjax {

#define MPMJAX_JOINED(a, b) a##_##b
#define MPMJAX_NAME(target, number) MPMJAX_JOINED(target, number)
#define MPMJAX_SET(number)                                           \
  extern const KernelSet<number> MPMJAX_NAME(MPMJAX_TARGET, number); \
  const KernelSet<number> MPMJAX_NAME(MPMJAX_TARGET, number) = {sums<number>, ::eigen<number>, ::rotation<number>, \
                                                                ::combine<number>, ::product<number>};

#if defined(MPMJAX_NUMBER)
MPMJAX_SET(MPMJAX_NUMBER)
#else
MPMJAX_SET(float)
MPMJAX_SET(double)
#endif

}  // namespace mpmjax
