// The instruction sets that the kernels are compiled for, and which one this machine takes.

#pragma once

#include "matrices.h"
#include "problems.h"

namespace mpmjax {

// The sums of d dimensions with s nodes along an axis; of a differential by the factors if asked for. Null where
// there is none. The first argument names the type, here as of the decompositions of matrices.
#define MPMJAX_DECLARE(target)                                       \
  const Kernels<float>* kernels_##target(float, int, int, bool);     \
  const Kernels<double>* kernels_##target(double, int, int, bool);   \
  const MatrixKernels<float>& matrix_kernels_##target(float);        \
  const MatrixKernels<double>& matrix_kernels_##target(double);
MPMJAX_DECLARE(baseline)
#if defined(MPMJAX_X86)
MPMJAX_DECLARE(avx2)
MPMJAX_DECLARE(avx512)
#endif
#undef MPMJAX_DECLARE

// Those of the best instruction set that this machine has.
const Kernels<float>* kernels(float, int d, int s, bool differential);
const Kernels<double>* kernels(double, int d, int s, bool differential);

const MatrixKernels<float>& matrix_kernels(float);
const MatrixKernels<double>& matrix_kernels(double);

// Its name.
const char* instructions();

}  // namespace mpmjax
