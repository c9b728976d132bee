// The sums, as plain data: arrays in C order with their sizes.
//
// With the stencil weights w_ip and gradients g_ip,b of nodes i, particles p and directions b, values f at the nodes and
// a, a_b at the particles,
//
//   scatter  f_i  = Σ_p (w_ip a_p + Σ_b g_ip,b a_p,b)
//   gather   a_p  = Σ_i w_ip f_i,   a_p,b = Σ_i g_ip,b f_i
//   average  m_i, the last column of a scatter, and the others divided by it
//   pull     ∂B/∂t,   B = Σ_ip f_i · (w_ip a_p + Σ_b g_ip,b a_p,b)
//   resist   the scatter of K_p times the gather's gradients, with a symmetric matrix K_p for each particle
//
// Weights are products of one polynomial along each axis, of the particle's offset t; of a gradient's the one along its
// direction is a slope. First nodes and offsets are given, (d, p) each, and the polynomials.

#pragma once

#include <cstdint>

namespace mpmjax {

constexpr int kMostAxes = 3;
constexpr int kMostNodes = 4;                   // along an axis
constexpr int kMostTerms = 2 * kMostNodes + 1;  // of the squares of a gradient's polynomials
constexpr int kBlock = 16;                      // particles that are handled together
constexpr int64_t kChunk = 64;                  // numbers of the nodes that are passed over together
constexpr int64_t kCached = 1 << 21;            // bytes of an array that a cache may hold from one pass to the next

// How nodes are numbered, and the polynomials. The i-th node along an axis, from a particle's first one on, has
// Σ_k c_ik (t − τ_i)^k.
template <class T>
struct Basis {
  int32_t shape[kMostAxes], strides[kMostAxes];
  bool periodic[kMostAxes];  // whether after an axis' last node come its first ones
  int terms;                 // of each polynomial
  T knots[kMostNodes];       // τ
  T weights[kMostNodes][kMostTerms], slopes[kMostNodes][kMostTerms];  // c
};

template <class T>
struct Stencils {
  const int32_t* first;  // (d, p)
  const T* offset;       // t, (d, p)
  const T* change;       // dt, for the differential of a sum along it; null for the sum itself
  int64_t particles;
  Basis<T> basis;
};

template <class T>
struct Gather {
  Stencils<T> stencils;
  const T* nodes;   // (n, c)
  T* value;         // a, (c, p)
  T* gradients;     // a_b for each direction, (d, c, p)
  int64_t size;     // n
  int64_t columns;  // c
};

// What particles give in a scatter or a pull.
template <class T>
struct ParticleValues {
  const T* value;      // a, (c, p), or null for zero
  const T* gradients;  // a_b, (d, k, p), zero in columns from k on; or null for zero
  int64_t graded;      // k
};

// The flat indices that a block of particles may reach.
struct Range {
  int32_t least, most;
};

template <class T>
struct Scatter {
  Stencils<T> stencils;
  ParticleValues<T> values;
  T* nodes;             // (n, c)
  const Range* ranges;  // of each block, or null
  bool* reached;        // false, for each of the ⌈n/64⌉ blocks of nodes; or null, where nodes are few
  int64_t size;
  int64_t columns;
  const bool* wanted;  // which of the nodes' ⌈n c/64⌉ blocks are, null for all; others may become anything
};

// Where the last column is not more than the least, all are zero.
template <class T>
struct Average {
  Stencils<T> stencils;
  ParticleValues<T> values;
  const T* least;
  T* whole;             // the last column, (n)
  T* means;             // the others divided by it, (n, c − 1)
  T* sums;              // memory to work in, (n, c)
  const Range* ranges;  // as in a scatter, and so the next
  bool* reached;
  int64_t size;
  int64_t columns;  // c
};

template <class T>
struct Pull {
  Stencils<T> stencils;
  const T* nodes;     // (n, c)
  ParticleValues<T> values;
  T* by_offset;       // (d, p)
  T* value;           // the gather of the nodes, as in a gather; null where it is not wanted
  T* gradients;
  int64_t size;
  int64_t columns;
};

// Σ_p Σ_b g_ip,b r_p,b with r_p = K_p G_p and G_p,b = Σ_j g_jp,b u_j, all in d columns. K_p is a symmetric matrix on the
// d² components of a gradient, b first, given by its upper triangle, row by row.
template <class T>
struct Resist {
  Stencils<T> stencils;
  const T* matrices;    // K, (d² (d² + 1) / 2, p)
  const T* moved;       // u, (n, d)
  T* nodes;             // (n, d)
  T* gradients;         // r_b for each direction, (d, d, p), where they are stored
  const Range* ranges;  // of each block, or null
  int64_t size;
  int64_t columns;  // d
  const bool* wanted;  // as in a scatter
};

// The sums for one dimension and kernel. Those of d and d + 1 columns, vectors at the nodes without and with a mass, have
// code of their own; others are summed in four columns at a time. Gather and pull take particles from a first to a last.
// Others take all particles, and set the nodes from a first to a last; they pass over blocks whose range of indices says
// that they give nothing to these. `resist_particles` stores what the particles from a first to a last give.
template <class T>
struct Kernels {
  void (*gather)(const Gather<T>&, int64_t first, int64_t last);
  void (*scatter)(const Scatter<T>&, int64_t first, int64_t last);
  void (*average)(const Average<T>&, int64_t first, int64_t last);
  void (*find_ranges)(const Stencils<T>&, int64_t first_block, int64_t last_block, Range* ranges);
  void (*pull)(const Pull<T>&, int64_t first, int64_t last);
  void (*resist)(const Resist<T>&, int64_t first, int64_t last);
  void (*resist_particles)(const Resist<T>&, int64_t first, int64_t last);
};

}  // namespace mpmjax
