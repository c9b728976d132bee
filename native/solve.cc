#include "solve.h"

#include <atomic>
#include <cmath>
#include <cstring>
#include <limits>

#include "active.h"
#include "vectors.h"
#include "wipe.h"

namespace mpmjax {
namespace {

class OneThread : public Pool {
 public:
  int threads() const override { return 1; }
  void schedule(std::function<void()> task) const override { task(); }
};

// The products and norms of a solve. What is not active is never read, but of what the resistance moves.
template <class T>
struct Space {
  const Pool& pool;
  const Recurrence<T>& of;
  const Division& division;
  int64_t size = of.nodes * of.columns;

  // W⁻¹A x into the image; false where there is no kernel of this form.
  bool apply(Form form) const {
    over_active(of.active, size, [&](int64_t i) { of.moved[i] = of.free[i] ? of.x[i] : T(0); });
    if (!resist(pool, form, 1, resistance(of), division)) return false;
    T square;
    product(pool, 1, Product<T>{of.image, of.x, of.mass, of.factor, of.free, of.weight, of.active, of.image, &square, size,
                                of.nodes, false});
    return true;
  }

  // ‖v‖² with v_i = value(i), each handed to put(i, v_i). The sum is that of products in double.
  template <class Value, class Put>
  T square(const Value& value, const Put& put) const {
    double sum = 0;
    over_active(of.active, size, [&](int64_t i) {
      const T v = value(i);
      put(i, v);
      sum += static_cast<double>(of.weight[i] * v) * v;
    });
    return static_cast<T>(sum);
  }

  // ‖v‖.
  T norm(const T* v) const {
    return std::sqrt(square([&](int64_t i) { return v[i]; }, [](int64_t, T) {}));
  }
};

template <class T>
bool run(const Pool& pool, Form form, const Solve<T>& task) {
  Recurrence<T> pass = task.recurrence;
  const Division division = divided(pool, form, 1, resistance(pass));
  const Space<T> space{pool, pass, division};
  const int64_t size = space.size;
  const std::unique_ptr<T[]> own(task.memory == nullptr ? new T[kVectors * size] : nullptr);
  T* const memory = task.memory == nullptr ? own.get() : task.memory;
  T *const x = pass.x, *const r = memory, *const last = r + size;
  pass.r = r, pass.p = last + size, pass.q = pass.p + size, pass.moved = pass.q + size, pass.image = pass.moved + size;
  wipe(pass.moved, size, 0, size);
  if (x != task.start) std::memcpy(x, task.start, static_cast<size_t>(size) * sizeof(T));
  const T b = space.norm(task.rhs), most = task.limits[1];
  T limits[kLimits] = {task.limits[0] * b, 0, 0, 0}, numbers[kNumbers] = {};
  T rr, before = std::numeric_limits<T>::infinity(), change = before, steps = 0, radius = 0;
  bool vanished = false, negative = false, stalled = false;
  pass.limits = limits, pass.numbers = numbers;
  while (true) {
    if (!space.apply(form)) return false;
    rr = space.square([&](int64_t i) { return task.rhs[i] - pass.image[i]; }, [&](int64_t i, T v) { r[i] = v; });
    stalled = rr > before / 4, before = rr;
    if (stalled || vanished || !(std::sqrt(rr) > limits[0]) || !(steps < most)) break;
    limits[1] = task.limits[2] * rr, limits[2] = most - steps, limits[3] = rr;
    over_active(pass.active, size, [&](int64_t i) { last[i] = x[i]; });
    if (!recur(pool, form, pass, division)) return false;
    change = std::sqrt(space.square([&](int64_t i) { return x[i] - last[i]; }, [](int64_t, T) {}));
    steps += numbers[1], radius = std::max(radius, numbers[2]);
    vanished = numbers[3] != 0, negative = negative || numbers[4] != 0;
  }
  const T found[kOutcome] = {rr, steps, radius, T(vanished), T(negative), change, T(stalled), b, space.norm(x)};
  std::copy(found, found + kOutcome, task.numbers);
  return true;
}

template <class T>
Solve<T> member(Solve<T> all, Form form, int64_t i) {
  Recurrence<T>& of = all.recurrence;
  const int64_t particles = of.stencils.particles;
  const int64_t size = of.nodes * of.columns, vectors = i * size;
  of.stencils = member(of.stencils, form, i);
  of.matrices += i * form.d * form.d * (form.d * form.d + 1) / 2 * particles;
  of.mass += i * of.nodes;
  of.factor += i;
  of.free += vectors, of.weight += vectors, of.x += vectors, all.start += vectors, all.rhs += vectors;
  of.active += i * ((size + kTogether - 1) / kTogether);
  all.limits += i * kTolerances;
  all.numbers += i * kOutcome;
  if (all.memory != nullptr) all.memory += i * kVectors * size;
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
