// What computes the problems of a batch on CPUs: functions on all threads, and the kernels that they call.

#pragma once

#include <vector>

#include "problems.h"
#include "share.h"

namespace mpmjax {

// The nodes of each member cut into parts, one for each thread, and the ranges of nodes that its blocks of particles
// reach. Where there is one part there are none, unless they are wanted.
struct Division {
  int64_t parts, blocks;
  std::vector<Range> ranges;
  std::vector<std::vector<int64_t>> cuts;
};

// Of a batch, on all threads of a pool, for float and double. Results have the same bits for any number of threads.
template <class T>
void gather(const Pool& pool, int64_t batch, const Gather<T>& first);
template <class T>
void scatter(const Pool& pool, int64_t batch, const Scatter<T>& first);
template <class T>
void average(const Pool& pool, int64_t batch, const Average<T>& first);
template <class T>
void p2g(const Pool& pool, int64_t batch, const P2G<T>& first);
template <class T>
void g2p(const Pool& pool, int64_t batch, const G2P<T>& first);
template <class T>
void pull(const Pool& pool, int64_t batch, const Pull<T>& first);
// The division of a resistance, which its particles' places alone decide, and the resistance with one found before.
template <class T>
Division divided(const Pool& pool, int64_t batch, const Resist<T>& first);
template <class T>
void resist(const Pool& pool, int64_t batch, const Resist<T>& first, const Division& division);
template <class T>
void resist(const Pool& pool, int64_t batch, const Resist<T>& first) {
  resist(pool, batch, first, divided(pool, batch, first));
}
// Each ends by itself. As many as there are threads or more are shared among them whole, each with its arrays in the
// cache of one core; fewer are done one by one by all threads.
template <class T>
void solve(const Pool& pool, int64_t batch, const Solve<T>& first);
template <class T>
void combine(const Pool& pool, int64_t batch, const Combine<T>& first);
template <class T>
void product(const Pool& pool, int64_t batch, const Product<T>& first);
template <class T>
void eigen(const Pool& pool, int64_t batch, const Eigen<T>& first);
template <class T>
void rotation(const Pool& pool, int64_t batch, const Rotation<T>& first);
void order(const Pool& pool, int64_t batch, const Order& first);
template <class T>
void rearrange(const Pool& pool, int64_t batch, const Rearrangement<T>& first);

// The sums for one dimension and kernel. Those of d and d + 1 columns, vectors at the nodes without and with a mass,
// have code of their own, as has a gather of one; others are summed in four columns at a time. Gather, pull and g2p take
// particles from a first to a last. Others take all particles, and set the nodes from a first to a last; they pass over
// blocks whose range of indices says that they give nothing to these. `resist_particles` stores what the particles from
// a first to a last give.
template <class T>
struct Kernels {
  void (*gather)(const Gather<T>&, int64_t first, int64_t last);
  void (*scatter)(const Scatter<T>&, int64_t first, int64_t last);
  void (*average)(const Average<T>&, int64_t first, int64_t last);
  void (*find_ranges)(const Stencils<T>&, int64_t first_block, int64_t last_block, Range* ranges, int64_t size,
                      bool* reached);
  void (*pull)(const Pull<T>&, int64_t first, int64_t last);
  void (*resist)(const Resist<T>&, int64_t first, int64_t last);
  void (*resist_particles)(const Resist<T>&, int64_t first, int64_t last);
  void (*p2g)(const P2G<T>&, int64_t first, int64_t last);
  void (*g2p)(const G2P<T>&, int64_t first, int64_t last);
};

// All kernels for numbers of one type. Decompositions are of particles' matrices from a first to a last; passes over
// blocks of vectors return their sum.
template <class T>
struct KernelSet {
  const Kernels<T>* (*sums)(int d, int s);
  void (*eigen)(const Eigen<T>&, int64_t first, int64_t last);
  void (*rotation)(const Rotation<T>&, int64_t first, int64_t last);
  double (*combine)(const Combine<T>&, int64_t first, int64_t last);
  double (*product)(const Product<T>&, int64_t first, int64_t last);
};

// The kernels of the best instruction set that this machine has, of those that they are compiled for.
template <class T>
const KernelSet<T>& kernels();

// The name of the instruction set; empty where this machine has none of them, and then no kernel may be called.
const char* instructions();

}  // namespace mpmjax
