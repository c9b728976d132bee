// The instruction sets that the kernels are compiled for, and which one this machine takes.

#pragma once

#include "problems.h"

namespace mpmjax {

// The kernels of d dimensions with s nodes along an axis; of a differential by the factors if asked for. Null where
// there is none. The first argument names the type.
#define MPMJAX_DECLARE(target)                                       \
  const Kernels<float>* kernels_##target(float, int, int, bool);     \
  const Kernels<double>* kernels_##target(double, int, int, bool);
MPMJAX_DECLARE(baseline)
#if defined(MPMJAX_X86)
MPMJAX_DECLARE(avx2)
MPMJAX_DECLARE(avx512)
#endif
#undef MPMJAX_DECLARE

// Those of the best instruction set that this machine has.
const Kernels<float>* kernels(float, int d, int s, bool differential);
const Kernels<double>* kernels(double, int d, int s, bool differential);

// Its name.
const char* instructions();

}  // namespace mpmjax
