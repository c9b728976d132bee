// What is computed, as plain data: arrays in C order with their sizes. CUDA reads it too.
//
// With the stencil weights w_ip and gradients g_ip,b of nodes i, particles p and directions b, values f at the nodes
// and a, a_b at the particles,
//
//   scatter  f_i  = Σ_p (w_ip a_p + Σ_b g_ip,b a_p,b)
//   gather   a_p  = Σ_i w_ip f_i,   a_p,b = Σ_i g_ip,b f_i
//   average  m_i, the last column of a scatter, and the others divided by it
//   pull     ∂B/∂ξ,   B = Σ_ip f_i · (w_ip a_p + Σ_b g_ip,b a_p,b)
//   resist   the scatter of K_p times the gather's gradients, with a symmetric matrix K_p for each particle
//
// Weights are products of one polynomial along each axis, of the offset t of the particle's place ξ; of a gradient's the
// one along its direction is a slope.
//
// Each problem lists its arrays once, in the order of XLA's operands and results: `arrays(f)` calls f(pointer, shape)
// for all of them, and f(pointer, shape, kOptional) for those that may be null. `batch` problems follow each other in
// every array.

#pragma once

#include <cstdint>
#include <initializer_list>

namespace mpmjax {

constexpr int kMostAxes = 3;
constexpr int kMostNodes = 4;                   // along an axis
constexpr int kMostTerms = 2 * kMostNodes + 1;  // of the squares of a gradient's polynomials
constexpr int kBlock = 16;                      // particles that are handled together
constexpr int64_t kChunk = 64;                  // numbers of the nodes that are passed over together
constexpr int64_t kCached = 1 << 21;            // bytes of an array that a cache may hold from one pass to the next

inline int64_t blocks_of(int64_t numbers, int64_t each = kChunk) { return (numbers + each - 1) / each; }

// The length of an array's axis: a size of the problem, which arrays from XLA set, or a number that follows from these.
struct Length {
  int64_t value;
  int64_t* size = nullptr;
  Length(int64_t& size) : value(size), size(&size) {}
  Length(const int64_t& number) : value(number) {}
};
using Lengths = std::initializer_list<Length>;
constexpr bool kOptional = true;

// The i-th problem of a batch.
template <class Problem>
Problem member(Problem all, int64_t i) {
  all.arrays([&](auto& array, Lengths shape, bool = false) {
    int64_t numbers = i;
    for (const Length& n : shape) numbers *= n.value;
    if (array != nullptr) array += numbers;
  });
  return all;
}

// How nodes are numbered, and the polynomials. The i-th node along an axis, from a particle's first one on, has
// Σ_k c_ik (t − τ_i)^k.
template <class T>
struct Basis {
  int d, s;  // axes, and nodes along each: one to three, and two to four
  int32_t shape[kMostAxes], strides[kMostAxes];
  bool periodic[kMostAxes];  // whether after an axis' last node come its first ones
  int terms;                 // of each polynomial
  T knots[kMostNodes];       // τ
  T weights[kMostNodes][kMostTerms], slopes[kMostNodes][kMostTerms];  // c
};

template <class T>
struct Stencils {
  const T* place;   // ξ, in spacings from the window's first node
  const T* change;  // dξ, for the differential of a sum along it; null for the sum itself
  int64_t particles;
  Basis<T> basis;

  template <class F>
  void arrays(const F& f) {
    f(place, {basis.d, particles});
  }
};

// What particles give in a scatter or a pull.
template <class T>
struct ParticleValues {
  const T* value;      // a, or null for zero
  const T* gradients;  // a_b, zero in columns from k on; or null for zero
  int64_t graded;      // k

  template <class F>
  void arrays(const F& f, int64_t d, int64_t& columns, int64_t& particles) {
    f(value, {columns, particles}, kOptional), f(gradients, {d, graded, particles}, kOptional);
  }
};

// The flat indices that a block of particles may reach.
struct Range {
  int32_t least, most;
};

template <class T>
struct Gather {
  Stencils<T> stencils;
  const T* nodes;
  T* value;         // a
  T* gradients;     // a_b for each direction
  int64_t size;     // number of nodes
  int64_t columns;  // numbers of each

  template <class F>
  void arrays(const F& f) {
    const int d = stencils.basis.d;
    int64_t& p = stencils.particles;
    stencils.arrays(f), f(stencils.change, {d, p}, kOptional), f(nodes, {size, columns});
    f(value, {columns, p}), f(gradients, {d, columns, p});
  }
};

template <class T>
struct Scatter {
  Stencils<T> stencils;
  ParticleValues<T> values;
  T* nodes;
  const Range* ranges;  // of each block, or null
  const bool* reached;  // which blocks of kChunk nodes particles reach; or null, where nodes are few
  int64_t size;
  int64_t columns;
  const bool* wanted;  // which blocks of kChunk numbers are, null for all; others may become anything

  template <class F>
  void arrays(const F& f) {
    const int d = stencils.basis.d;
    int64_t& p = stencils.particles;
    stencils.arrays(f), f(stencils.change, {d, p}, kOptional), values.arrays(f, d, columns, p);
    f(nodes, {size, columns}), f(reached, {blocks_of(size)}, kOptional);
    f(wanted, {blocks_of(size * columns)}, kOptional);
  }
};

// Where the last column is not more than the least, all are zero.
template <class T>
struct Average {
  Stencils<T> stencils;
  ParticleValues<T> values;
  const T* least;
  T* whole;             // the last column
  T* means;             // the others divided by it
  T* sums;              // memory to work in
  const Range* ranges;  // as in a scatter, and so the next
  const bool* reached;
  int64_t size;
  int64_t columns;

  template <class F>
  void arrays(const F& f) {
    stencils.arrays(f), f(least, {}), values.arrays(f, stencils.basis.d, columns, stencils.particles);
    f(whole, {size}), f(means, {size, columns - 1}), f(sums, {size, columns});
    f(reached, {blocks_of(size)}, kOptional);
  }
};

// An average of what particles have: of v, weighted with their mass, and the gradients a_b = m C_b D_b + factor (A Bᵀ)_b
// in spacings, with the moment D of the weights. C or A may be null, and B where it is the identity. Where there are
// numbers q and r of each particle, q B Bᵀ + r I stands for A Bᵀ, or r I alone.
template <class T>
struct P2G {
  Stencils<T> stencils;
  const T* least;
  const T* slope;   // 1/dx
  const T* factor;
  const T *mass, *v;
  const T* push;        // is added to all v
  const T *C, *A, *B;   // of each particle d rows of d
  const T *q, *r;
  T *whole, *means, *sums;  // as in an average, and so the next
  const Range* ranges;
  const bool* reached;
  int64_t size;
  int64_t columns;  // d + 1

  template <class F>
  void arrays(const F& f) {
    const int d = stencils.basis.d;
    int64_t& p = stencils.particles;
    stencils.arrays(f), f(least, {}), f(slope, {}), f(factor, {}), f(mass, {p}), f(v, {d, p});
    f(push, {d}, kOptional), f(C, {d, d, p}, kOptional), f(A, {d, d, p}, kOptional), f(B, {d, d, p}, kOptional);
    f(q, {p}, kOptional), f(r, {p}, kOptional);
    f(whole, {size}), f(means, {size, d}), f(sums, {size, columns}), f(reached, {blocks_of(size)}, kOptional);
  }
};

// A gather of a velocity, and the particles moved by it: x + Δt v, and F + Δt (∇v) F where there is an F. Results may lie
// where x and F do.
template <class T>
struct G2P {
  Stencils<T> stencils;
  const T* nodes;
  const T* slope;  // 1/dx
  const T* dt;
  const T *x, *F;
  T *value, *gradient;  // v and ∇v, the derivative's direction last
  T *moved, *strained;
  int64_t size;
  int64_t columns;  // d

  template <class Visit>
  void arrays(const Visit& f) {
    const int d = stencils.basis.d;
    int64_t& p = stencils.particles;
    stencils.arrays(f), f(nodes, {size, columns}), f(slope, {}), f(dt, {}), f(x, {d, p});
    f(F, {d, d, p}, kOptional);
    f(value, {d, p}), f(gradient, {d, d, p}), f(moved, {d, p}), f(strained, {d, d, p}, kOptional);
  }
};

template <class T>
struct Pull {
  Stencils<T> stencils;
  const T* nodes;
  ParticleValues<T> values;
  T* by_place;
  T* value;  // the gather of the nodes, as in a gather; null where it is not wanted
  T* gradients;
  int64_t size;
  int64_t columns;

  template <class F>
  void arrays(const F& f) {
    const int d = stencils.basis.d;
    int64_t& p = stencils.particles;
    stencils.arrays(f), f(nodes, {size, columns}), values.arrays(f, d, columns, p), f(by_place, {d, p});
    f(value, {columns, p}, kOptional), f(gradients, {d, columns, p}, kOptional);
  }
};

// Entries of a symmetric matrix on the d² components of a gradient, b first: its upper triangle, row by row.
constexpr int64_t matrix_entries(int64_t d) { return d * d * (d * d + 1) / 2; }

// Σ_p Σ_b g_ip,b r_p,b with r_p = K_p G_p and G_p,b = Σ_j g_jp,b u_j, all in d columns, and symmetric matrices K_p.
template <class T>
struct Resist {
  Stencils<T> stencils;
  const T* matrices;    // K
  const T* moved;       // u
  T* nodes;
  T* gradients;         // r_b for each direction, where they are stored
  const Range* ranges;  // of each block, or null
  int64_t size;
  int64_t columns;     // d
  const bool* wanted;  // as in a scatter

  template <class F>
  void arrays(const F& f) {
    const int d = stencils.basis.d;
    int64_t& p = stencils.particles;
    stencils.arrays(f), f(matrices, {matrix_entries(d), p}), f(moved, {size, columns}), f(nodes, {size, columns});
    f(gradients, {d, d, p}, kOptional), f(wanted, {blocks_of(size * columns)}, kOptional);
  }
};

// A solve by the conjugate residual method: W⁻¹A x = W⁻¹b, with A = M + χH on free components and the identity on
// others, and H the resistance of the particles. The recurrence begins at `start`, and again from the true residual
// where it ends, until ‖r‖ is within its tolerance, has not halved, or steps are used up.
constexpr int kTolerances = 3, kOutcome = 9, kVectors = 5;

template <class T>
struct Solve {
  Stencils<T> stencils;
  const T* matrices;   // K, as in a resistance
  const T* mass;       // M, of each node
  const T* factor;     // χ
  const bool* free;
  const T* weight;     // W
  const bool* active;  // for each block of kChunk components, as in a combination
  const T* start;      // where x starts, which may lie where x does; zero wherever nothing is active or free
  const T* rhs;        // W⁻¹b; likewise
  const T* limits;     // ‖r‖/‖W⁻¹b‖ to reach; most steps; part of ‖r‖² at a start that is the recurrence's floor
  T* x;
  // ‖r‖², steps, largest |rᵀA r|/‖r‖², whether rᵀA r vanished, whether it was negative, the change of x by the last
  // recurrence, whether that has not halved ‖r‖, ‖W⁻¹b‖, and ‖x‖, all in the norm of W.
  T* numbers;
  T* memory;  // to work in
  int64_t nodes;
  int64_t room;  // numbers in `memory`: kVectors times those of x, or none where each problem takes its own

  template <class F>
  void arrays(const F& f) {
    stencils.arrays(f), f(matrices, {matrix_entries(stencils.basis.d), stencils.particles}), f(mass, {nodes});
    const int64_t size = nodes * stencils.basis.d;
    f(factor, {}), f(free, {size}), f(weight, {size}), f(active, {blocks_of(size)}), f(start, {size}), f(rhs, {size});
    f(limits, {kTolerances}), f(x, {size}), f(numbers, {kOutcome}), f(memory, {room});
  }
};

// y = a + s_0 b, z = c + s_1 d and Σ w z². Where `active` is false, all of a, b, c and d are zero. A result may be what
// one of its two vectors was.
template <class T>
struct Combine {
  const T *a, *b, *c, *d;
  const T* scales;  // s_0, s_1
  const T* weight;
  const bool* active;  // for each block of kChunk numbers
  T *y, *z, *sum;
  int64_t size;

  template <class F>
  void arrays(const F& f) {
    f(a, {size}), f(b, {size}), f(c, {size}), f(d, {size}), f(scales, {2}), f(weight, {size});
    f(active, {blocks_of(size)}), f(y, {size}), f(z, {size}), f(sum, {});
  }
};

// What is left of a product with A = M + χH on free components, once the force f = H v is known: the image y = W⁻¹A v,
// with (A v)_i = m_i v_i + χ f_i where i is free and v_i elsewhere, and Σ v (A v). Where `active` is false v is zero,
// and nothing free; the image is zero there if it is `whole`, and else left as it was. It may be where the force was.
template <class T>
struct Product {
  const T *force, *v;
  const T* mass;    // of each node, that of size/nodes components
  const T* factor;  // χ
  const bool* free;
  const T* weight;
  const bool* active;
  T *image, *sum;
  int64_t size, nodes;
  bool whole = true;

  template <class F>
  void arrays(const F& f) {
    f(force, {size}), f(v, {size}), f(mass, {nodes}), f(factor, {}), f(free, {size}), f(weight, {size});
    f(active, {blocks_of(size)}), f(image, {size}), f(sum, {});
  }
};

// S = V diag(w) Vᵀ of symmetric 3 x 3 matrices, of which only the upper triangle is read. Eigenvalues have no order,
// det V = 1.
template <class T>
struct Eigen {
  const T* matrices;  // S
  T* values;          // w
  T* vectors;         // V
  int64_t particles;

  template <class F>
  void arrays(const F& f) {
    f(matrices, {3, 3, particles}), f(values, {3, particles}), f(vectors, {3, 3, particles});
  }
};

// The rotation R of F = R S, which maximises tr(RᵀF), of 3 x 3 matrices.
template <class T>
struct Rotation {
  const T* matrices;  // F
  T* rotations;       // R
  int64_t particles;

  template <class F>
  void arrays(const F& f) {
    f(matrices, {3, 3, particles}), f(rotations, {3, 3, particles});
  }
};

// The order of numbers from the least to the largest, where equal ones keep theirs.
struct Order {
  const int32_t* keys;
  int32_t* order;  // the number of the key that is the least, of the next one, ...
  int64_t count;

  template <class F>
  void arrays(const F& f) {
    f(keys, {count}), f(order, {count});
  }
};

// Numbers of particles in another order of these, or as they are where it is not wanted. They may come from and go to
// the same memory.
template <class T>
struct Rearrangement {
  const bool* wanted;
  const int32_t* order;  // what comes k-th is of particle order[k]; with `inverse` what comes order[k]-th of the k-th
  const T* from;
  T* to;
  int64_t rows, count;
  bool inverse;

  template <class F>
  void arrays(const F& f) {
    f(wanted, {}), f(order, {count}), f(from, {rows, count}), f(to, {rows, count});
  }
};

}  // namespace mpmjax
