// The sums for every dimension and kernel, and the passes over arrays, compiled once for each instruction set:
// MPMJAX_TARGET is its name.

#include "average.h"
#include "eigen.h"
#include "gather.h"
#include "passes.h"
#include "pull.h"
#include "resist.h"
#include "rotation.h"
#include "targets.h"

namespace {

using mpmjax::Kernels;

template <class T, int d, int s>
const Kernels<T>* of(bool differential) {
  static constexpr Kernels<T> sums = {gather<T, d, s, false>, scatter<T, d, s, false>, average<T, d, s>,
                                      find_ranges<T, d, s>,   pull<T, d, s>,           resist<T, d, s>,
                                      resist_particles<T, d, s>};
  static constexpr Kernels<T> differentials = {gather<T, d, s, true>, scatter<T, d, s, true>, nullptr, find_ranges<T, d, s>,
                                               nullptr,               nullptr,                nullptr};
  return differential ? &differentials : &sums;
}

template <class T, int d>
const Kernels<T>* of(int s, bool differential) {
  switch (s) {
    case 2: return of<T, d, 2>(differential);
    case 3: return of<T, d, 3>(differential);
    case 4: return of<T, d, 4>(differential);
    default: return nullptr;
  }
}

template <class T>
const Kernels<T>* of(int d, int s, bool differential) {
  switch (d) {
    case 1: return of<T, 1>(s, differential);
    case 2: return of<T, 2>(s, differential);
    case 3: return of<T, 3>(s, differential);
    default: return nullptr;
  }
}

template <class T>
const mpmjax::ArrayKernels<T>& arrays() {
  static constexpr mpmjax::ArrayKernels<T> kernels = {eigen<T>, rotation<T>, combine<T>, product<T>};
  return kernels;
}

}  // namespace

namespace mpmjax {

#define MPMJAX_JOINED(a, b) a##b
#define MPMJAX_KERNELS(target) MPMJAX_JOINED(kernels_, target)
#define MPMJAX_ARRAY_KERNELS(target) MPMJAX_JOINED(array_kernels_, target)

const Kernels<float>* MPMJAX_KERNELS(MPMJAX_TARGET)(float, int d, int s, bool differential) {
  return of<float>(d, s, differential);
}

const Kernels<double>* MPMJAX_KERNELS(MPMJAX_TARGET)(double, int d, int s, bool differential) {
  return of<double>(d, s, differential);
}

const ArrayKernels<float>& MPMJAX_ARRAY_KERNELS(MPMJAX_TARGET)(float) { return arrays<float>(); }
const ArrayKernels<double>& MPMJAX_ARRAY_KERNELS(MPMJAX_TARGET)(double) { return arrays<double>(); }

}  // namespace mpmjax
