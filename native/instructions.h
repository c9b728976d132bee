// The kernels of the best instruction set that this machine has, of those that they are compiled for.

#pragma once

#include "matrices.h"
#include "problems.h"
#include "vectors.h"

namespace mpmjax {

// All kernels for numbers of one type. Decompositions are of particles' matrices from a first to a last; passes over
// blocks of vectors return their sum.
template <class T>
struct KernelSet {
  const Kernels<T>* (*sums)(int d, int s);  // null where there are none
  void (*eigen)(const Eigen<T>&, int64_t first, int64_t last);
  void (*rotation)(const Rotation<T>&, int64_t first, int64_t last);
  double (*combine)(const Combine<T>&, int64_t first, int64_t last);
  double (*product)(const Product<T>&, int64_t first, int64_t last);
};

// Of the two types.
template <class T>
const KernelSet<T>& kernels();

// The name of the instruction set; empty where this machine has none of them, and then no kernel may be called.
const char* instructions();

}  // namespace mpmjax
