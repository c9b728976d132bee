// All kernels for one instruction set, MPMJAX_TARGET, and one type of numbers, MPMJAX_NUMBER: each pair is compiled by
// itself, at the same time as others and in a part of the memory. Without a type, both.

#include "average.h"
#include "eigen.h"
#include "gather.h"
#include "instructions.h"
#include "passes.h"
#include "pull.h"
#include "resist.h"
#include "rotation.h"

namespace {

using mpmjax::Kernels;

template <class T, int d, int s>
constexpr Kernels<T> sums_of = {gather<T, d, s>, scatter<T, d, s>, average<T, d, s>,         find_ranges<T, d, s>,
                                pull<T, d, s>,   resist<T, d, s>,  resist_particles<T, d, s>};

template <class T, int d>
const Kernels<T>* sums(int s) {
  switch (s) {
    case 2: return &sums_of<T, d, 2>;
    case 3: return &sums_of<T, d, 3>;
    case 4: return &sums_of<T, d, 4>;
    default: return nullptr;
  }
}

template <class T>
const Kernels<T>* sums(int d, int s) {
  switch (d) {
    case 1: return sums<T, 1>(s);
    case 2: return sums<T, 2>(s);
    case 3: return sums<T, 3>(s);
    default: return nullptr;
  }
}

template <class T>
constexpr mpmjax::KernelSet<T> all = {sums<T>, eigen<T>, rotation<T>, combine<T>, product<T>};

}  // namespace

namespace mpmjax {

#define MPMJAX_JOINED(a, b) a##_##b
#define MPMJAX_NAME(target, number) MPMJAX_JOINED(target, number)
#define MPMJAX_SET(number)                                           \
  extern const KernelSet<number> MPMJAX_NAME(MPMJAX_TARGET, number); \
  const KernelSet<number> MPMJAX_NAME(MPMJAX_TARGET, number) = all<number>;

#if defined(MPMJAX_NUMBER)
MPMJAX_SET(MPMJAX_NUMBER)
#else
MPMJAX_SET(float)
MPMJAX_SET(double)
#endif

}  // namespace mpmjax
