// The instruction sets that the kernels are compiled for, and which one this machine takes.

#pragma once

#include "matrices.h"
#include "problems.h"
#include "vectors.h"

namespace mpmjax {

// Passes over arrays: decompositions of particles' matrices from a first to a last, and over blocks of vectors, which return
// their sum.
template <class T>
struct ArrayKernels {
  void (*eigen)(const Eigen<T>&, int64_t first, int64_t last);
  void (*rotation)(const Rotation<T>&, int64_t first, int64_t last);
  double (*combine)(const Combine<T>&, int64_t first, int64_t last);
  double (*product)(const Product<T>&, int64_t first, int64_t last);
};

// The sums of d dimensions with s nodes along an axis; of a differential by the factors if asked for. Null where
// there is none. The first argument names the type, here as of the passes over arrays.
#define MPMJAX_DECLARE(target)                                       \
  const Kernels<float>* kernels_##target(float, int, int, bool);     \
  const Kernels<double>* kernels_##target(double, int, int, bool);   \
  const ArrayKernels<float>& array_kernels_##target(float);          \
  const ArrayKernels<double>& array_kernels_##target(double);
MPMJAX_DECLARE(baseline)
#if defined(MPMJAX_X86)
MPMJAX_DECLARE(avx2)
MPMJAX_DECLARE(avx512)
#endif
#undef MPMJAX_DECLARE

// Those of the best instruction set that this machine has.
const Kernels<float>* kernels(float, int d, int s, bool differential);
const Kernels<double>* kernels(double, int d, int s, bool differential);

const ArrayKernels<float>& array_kernels(float);
const ArrayKernels<double>& array_kernels(double);

// Its name.
const char* instructions();

}  // namespace mpmjax
