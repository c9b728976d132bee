#include "solve.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstring>
#include <functional>
#include <limits>
#include <memory>

#include "vectors.h"

namespace mpmjax {
namespace {

class OneThread : public Pool {
 public:
  int threads() const override { return 1; }
  void schedule(std::function<void()> task) const override { task(); }
};

// What a solve needs beside its recurrence: W⁻¹A x, differences and norms.
template <class T>
struct Space {
  const Pool& pool;
  const Recurrence<T>& of;
  int64_t size = of.nodes * of.columns;
  std::unique_ptr<T[]> moved{new T[size]()}, image{new T[size]()}, spare{new T[size]()};

  // W⁻¹A x into the image; false where there is no kernel of this form.
  bool apply(Form form, const T* x) {
    for (int64_t k = 0; k * kTogether < size; ++k) {
      if (!of.active[k]) continue;
      const int64_t last = std::min(size, (k + 1) * kTogether);
      for (int64_t i = k * kTogether; i < last; ++i) moved[i] = of.free[i] ? x[i] : T(0);
    }
    Resist<T> force = {};
    force.stencils = of.stencils, force.matrices = of.matrices, force.moved = moved.get(), force.nodes = image.get();
    force.size = of.nodes, force.columns = of.columns;
    if (!resist(pool, form, 1, force)) return false;
    T square;
    Product<T> rest = {};
    rest.force = rest.image = image.get(), rest.v = x, rest.mass = of.mass, rest.factor = of.factor, rest.free = of.free;
    rest.weight = of.weight, rest.active = of.active, rest.sum = &square, rest.size = size, rest.nodes = of.nodes;
    product(pool, 1, rest);
    return true;
  }

  // The difference of two vectors, and the square of its norm.
  T difference(const T* one, const T* other, T* to) {
    T square;
    const T scales[] = {T(-1), T(-1)};
    combine(pool, 1, Combine<T>{one, other, one, other, scales, of.weight, of.active, spare.get(), to, &square, size});
    return square;
  }
};

template <class T>
bool run(const Pool& pool, Form form, const Solve<T>& task) {
  Recurrence<T> pass = task.recurrence;
  Space<T> space{pool, task.recurrence};
  const size_t bytes = static_cast<size_t>(space.size) * sizeof(T);
  const std::unique_ptr<T[]> r(new T[space.size]()), last(new T[space.size]()), zero(new T[space.size]());
  if (pass.x != pass.start) std::memcpy(pass.x, pass.start, bytes);
  std::memcpy(last.get(), pass.x, bytes);
  const T b = std::sqrt(space.difference(task.rhs, zero.get(), r.get())), most = task.limits[1];
  T limits[kLimits] = {task.limits[0] * b, 0, 0, 0}, numbers[kNumbers] = {};
  T rr, before = std::numeric_limits<T>::infinity(), steps = 0, radius = 0, change;
  bool vanished = false, negative = false, stalled = false;
  pass.start = pass.x, pass.residual = r.get(), pass.limits = limits, pass.numbers = numbers;
  while (true) {
    if (!space.apply(form, pass.x)) return false;
    rr = space.difference(task.rhs, space.image.get(), r.get());
    change = space.difference(pass.x, last.get(), last.get());
    std::memcpy(last.get(), pass.x, bytes);
    stalled = rr > before / 4, before = rr;
    if (stalled || vanished || !(std::sqrt(rr) > limits[0]) || !(steps < most)) break;
    limits[1] = task.limits[2] * rr, limits[2] = most - steps, limits[3] = rr;
    if (!recur(pool, form, pass)) return false;
    rr = numbers[0], steps += numbers[1], radius = std::max(radius, numbers[2]);
    vanished = numbers[3] != 0, negative = negative || numbers[4] != 0;
  }
  const T x = std::sqrt(space.difference(pass.x, zero.get(), r.get()));
  const T found[kOutcome] = {rr, steps, radius, T(vanished), T(negative), std::sqrt(change), T(stalled), b, x};
  std::copy(found, found + kOutcome, task.numbers);
  return true;
}

template <class T>
Solve<T> member(Solve<T> all, Form form, int64_t i) {
  Recurrence<T>& of = all.recurrence;
  const int64_t particles = of.stencils.particles, factors = i * form.d * form.s * particles;
  const int64_t size = of.nodes * of.columns, vectors = i * size;
  of.stencils.index += factors;
  of.stencils.weights += factors;
  of.stencils.derivatives += factors;
  of.matrices += i * form.d * form.d * (form.d * form.d + 1) / 2 * particles;
  of.mass += i * of.nodes;
  of.factor += i;
  of.free += vectors, of.weight += vectors, of.start += vectors, of.x += vectors, all.rhs += vectors;
  of.active += i * ((size + kTogether - 1) / kTogether);
  all.limits += i * kTolerances;
  all.numbers += i * kOutcome;
  return all;
}

template <class T>
bool solve_all(const Pool& pool, Form form, int64_t batch, const Solve<T>& all) {
  std::atomic<bool> known{true};
  if (batch >= pool.threads()) {
    share(pool, batch, [&](int64_t i) {
      if (!run(OneThread(), form, member(all, form, i))) known = false;
    });
  } else {
    for (int64_t i = 0; i < batch; ++i) known = run(pool, form, member(all, form, i)) && known;
  }
  return known;
}

}  // namespace

bool solve(const Pool& p, Form f, int64_t b, const Solve<float>& s) { return solve_all(p, f, b, s); }
bool solve(const Pool& p, Form f, int64_t b, const Solve<double>& s) { return solve_all(p, f, b, s); }

}  // namespace mpmjax
