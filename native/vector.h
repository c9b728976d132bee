// Four numbers at once, and numbers with a differential.
//
// Rows of nodes and of particles are handled four columns at a time, in the vector extension that GCC and Clang share:
// one source for SSE, AVX and NEON. Everything is in an anonymous namespace, because files that include this are
// compiled once for each instruction set and must not share a function.

#pragma once

#include <cstdint>
#include <cstring>

#define MPMJAX_INLINE inline __attribute__((always_inline))
#define MPMJAX_INLINE_LAMBDA __attribute__((always_inline))
#define MPMJAX_APART __attribute__((noinline))  // once, not in each of its many uses

namespace {

constexpr int kLanes = 4;

template <class T>
struct VectorOf {
  typedef T type __attribute__((vector_size(kLanes * sizeof(T))));
  typedef T half __attribute__((vector_size(kLanes / 2 * sizeof(T))));
};

template <class T>
using Vector = typename VectorOf<T>::type;

// A vector at any address.
template <class T>
MPMJAX_INLINE Vector<T> load(const T* from) {
  Vector<T> v;
  std::memcpy(&v, from, sizeof v);
  return v;
}

template <class T>
MPMJAX_INLINE void store(T* to, Vector<T> v) {
  std::memcpy(to, &v, sizeof v);
}

// The first `count` lanes; the others are zero.
template <class T>
MPMJAX_INLINE Vector<T> load_some(const T* from, int count) {
  Vector<T> v = {};
  for (int lane = 0; lane < kLanes; ++lane) {
    if (lane < count) v[lane] = from[lane];
  }
  return v;
}

// Adds the first `count` lanes to as many numbers. What is beyond them is not touched, not even by a zero.
template <int count, class T>
MPMJAX_INLINE void add_some(T* to, Vector<T> v) {
  static_assert(count >= 1 && count <= kLanes, "a vector has four lanes");
  if constexpr (count == kLanes) {
    store(to, load(to) + v);
  } else if constexpr (count == 1) {
    to[0] += v[0];
  } else {
    typename VectorOf<T>::half low = {v[0], v[1]}, sum;
    std::memcpy(&sum, to, sizeof sum);
    sum += low;
    std::memcpy(to, &sum, sizeof sum);
    if constexpr (count == 3) to[2] += v[2];
  }
}

// Four integers as wide as the numbers: choices of lanes and masks of their bits.
template <class T>
struct LanesOf {
  typedef int32_t type __attribute__((vector_size(kLanes * sizeof(int32_t))));
};
template <>
struct LanesOf<double> {
  typedef int64_t type __attribute__((vector_size(kLanes * sizeof(int64_t))));
};
template <class T>
using Lanes = typename LanesOf<T>::type;

#if defined(__clang__)
#define MPMJAX_SHUFFLE(a, b, i, j, k, l) __builtin_shufflevector(a, b, i, j, k, l)
#else
#define MPMJAX_SHUFFLE(a, b, i, j, k, l) __builtin_shuffle(a, b, Lanes<T>{i, j, k, l})
#endif

// The transpose of four vectors.
template <class T>
MPMJAX_INLINE void transpose(const Vector<T>* from, Vector<T>* to) {
  const Vector<T> a = MPMJAX_SHUFFLE(from[0], from[1], 0, 4, 1, 5), b = MPMJAX_SHUFFLE(from[0], from[1], 2, 6, 3, 7);
  const Vector<T> c = MPMJAX_SHUFFLE(from[2], from[3], 0, 4, 1, 5), d = MPMJAX_SHUFFLE(from[2], from[3], 2, 6, 3, 7);
  to[0] = MPMJAX_SHUFFLE(a, c, 0, 1, 4, 5);
  to[1] = MPMJAX_SHUFFLE(a, c, 2, 3, 6, 7);
  to[2] = MPMJAX_SHUFFLE(b, d, 0, 1, 4, 5);
  to[3] = MPMJAX_SHUFFLE(b, d, 2, 3, 6, 7);
}

// Calls f(0), ..., f(count - 1): written out, or as a loop where speed matters less than the size of the code.
template <int count, bool written_out, class F>
MPMJAX_INLINE void each(const F& f) {
  if constexpr (written_out) {
    static_assert(count <= 4, "as many nodes as the cubic kernel has");
    f(0);
    if constexpr (count > 1) f(1);
    if constexpr (count > 2) f(2);
    if constexpr (count > 3) f(3);
  } else {
#if defined(__clang__)
#pragma clang loop unroll(disable) vectorize(disable)
#else
#pragma GCC unroll 1
#endif
    for (int i = 0; i < count; ++i) f(i);
  }
}

// x + ε dx with ε² = 0: arithmetic with such numbers gives differentials.
template <class X>
struct Dual {
  X value;
  X change;
};

MPMJAX_INLINE Vector<float> product(float a, Vector<float> x) { return a * x; }
MPMJAX_INLINE Vector<double> product(double a, Vector<double> x) { return a * x; }

template <class T>
MPMJAX_INLINE Dual<Vector<T>> product(Dual<T> a, Vector<T> x) {
  return {a.value * x, a.change * x};
}

template <class T>
MPMJAX_INLINE Dual<Vector<T>> product(Dual<T> a, Dual<Vector<T>> x) {
  return {a.value * x.value, a.value * x.change + a.change * x.value};
}

template <class X>
MPMJAX_INLINE Dual<X> operator+(Dual<X> a, Dual<X> b) {
  return {a.value + b.value, a.change + b.change};
}

// What a sum returns: the number itself, or of a number with a differential the differential.
template <class X>
MPMJAX_INLINE X result(X x) {
  return x;
}

template <class X>
MPMJAX_INLINE X result(Dual<X> x) {
  return x.change;
}

}  // namespace
