// The kernels of CPUs, which are compiled for each instruction set. Each takes particles, nodes or blocks from a first to
// before a last.

#pragma once

#include <tuple>

#include "problems.h"

namespace mpmjax {

template <class Problem>
using Kernel = void (*)(const Problem&, int64_t first, int64_t last);

// The sums for one dimension and kernel. In two and three, those of d and d + 1 columns, vectors at the nodes without and
// with a mass, have code of their own, as has a gather of one; others are summed in four columns at a time. Gather, pull
// and g2p take some particles. Others take all particles, and set some nodes; they pass over blocks whose range of
// indices says that they give nothing to these. A resistance that is to store gradients does so for some particles, and
// sets no node.
template <class T>
struct Kernels {
  std::tuple<Kernel<Gather<T>>, Kernel<Pull<T>>, Kernel<G2P<T>>, Kernel<Scatter<T>>, Kernel<Average<T>>, Kernel<P2G<T>>,
             Kernel<Resist<T>>>
      sums;
  // Of blocks of particles. Where `reached` is not null, marks blocks of kChunk nodes of so many nodes.
  void (*find_ranges)(const Stencils<T>&, int64_t first, int64_t last, Range* ranges, int64_t size, bool* reached);
};

// All kernels for numbers of one type.
template <class T>
struct KernelSet {
  const Kernels<T>* (*sums)(int d, int s);
  Kernel<Eigen<T>> eigen;
  Kernel<Rotation<T>> rotation;
  // Of blocks of vectors; they return their sum.
  double (*combine)(const Combine<T>&, int64_t first, int64_t last);
  double (*product)(const Product<T>&, int64_t first, int64_t last);
};

// Those that are compiled for an instruction set.
struct avx2;
struct avx512;
struct baseline;
template <class Target, class T>
struct Compiled {
  static const KernelSet<T> kernels;
};

// The kernels of the best instruction set that this machine has, of those that they are compiled for.
template <class T>
const KernelSet<T>& kernels();

// The name of the instruction set; empty where this machine has none of them, and then no kernel may be called.
const char* instructions();

}  // namespace mpmjax
