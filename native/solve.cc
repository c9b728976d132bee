#include "solve.h"

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

  // W⁻¹A x into the image.
  void apply(Form form) const {
    over_active(of.active, size, [&](int64_t i) { of.moved[i] = of.free[i] ? of.x[i] : T(0); });
    resist(pool, form, 1, resistance(of), division);
    T square;
    product(pool, 1, Product<T>{of.image, of.x, of.mass, of.factor, of.free, of.weight, of.active, of.image, &square, size,
                                of.nodes, false});
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

// The recurrence. The division is that of the resistance.
template <class T>
void recur(const Pool& pool, Form form, const Recurrence<T>& task, const Division& division) {
  const int64_t size = task.nodes * task.columns;
  T *const r = task.r, *const p = task.p, *const q = task.q, *const moved = task.moved, *const image = task.image;
  over_active(task.active, size, [&](int64_t i) { p[i] = q[i] = 0; });
  const T eps = std::numeric_limits<T>::epsilon();
  T rr = task.limits[3], qq = 0, before = std::numeric_limits<T>::infinity(), radius = 0;
  int64_t steps = 0;
  bool vanished = false, negative = false;
  while (std::sqrt(rr) > task.limits[0] && rr > task.limits[1] && T(steps) < task.limits[2] && !vanished) {
    over_active(task.active, size, [&](int64_t i) { moved[i] = task.free[i] ? r[i] : T(0); });
    resist(pool, form, 1, resistance(task), division);
    T gamma, square;
    product(pool, 1, Product<T>{image, r, task.mass, task.factor, task.free, task.weight, task.active, image, &gamma, size,
                                task.nodes, false});
    const T beta = gamma / before, onward[] = {beta, beta};
    combine(pool, 1, Combine<T>{r, p, image, q, onward, task.weight, task.active, p, q, &square, size});
    const T rounding = eps * std::sqrt(rr * (square + beta * beta * qq));  // of γ: ε‖r‖‖s‖
    vanished = std::abs(gamma) <= rounding;
    negative = negative || gamma < -rounding;
    const T alpha = vanished ? T(0) : gamma / square, along[] = {alpha, -alpha};
    const T quotient = std::abs(gamma) / rr;
    if (!(quotient <= radius)) radius = quotient;
    combine(pool, 1, Combine<T>{task.x, p, r, q, along, task.weight, task.active, task.x, r, &rr, size});
    before = gamma, qq = square, ++steps;
  }
  const T numbers[kNumbers] = {rr, T(steps), radius, T(vanished), T(negative)};
  std::copy(numbers, numbers + kNumbers, task.numbers);
}

template <class T>
void run(const Pool& pool, Form form, const Solve<T>& task) {
  Recurrence<T> pass = task.recurrence;
  const Division division = divided(pool, form, 1, resistance(pass));
  const Space<T> space{pool, pass, division};
  const int64_t size = space.size;
  const std::unique_ptr<T[]> allocated(task.memory == nullptr ? new T[kVectors * size] : nullptr);
  T* const memory = task.memory == nullptr ? allocated.get() : task.memory;
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
    space.apply(form);
    rr = space.square([&](int64_t i) { return task.rhs[i] - pass.image[i]; }, [&](int64_t i, T v) { r[i] = v; });
    stalled = rr > before / 4, before = rr;
    if (stalled || vanished || !(std::sqrt(rr) > limits[0]) || !(steps < most)) break;
    limits[1] = task.limits[2] * rr, limits[2] = most - steps, limits[3] = rr;
    over_active(pass.active, size, [&](int64_t i) { last[i] = x[i]; });
    recur(pool, form, pass, division);
    change = std::sqrt(space.square([&](int64_t i) { return x[i] - last[i]; }, [](int64_t, T) {}));
    steps += numbers[1], radius = std::max(radius, numbers[2]);
    vanished = numbers[3] != 0, negative = negative || numbers[4] != 0;
  }
  const T result[kOutcome] = {rr, steps, radius, T(vanished), T(negative), change, T(stalled), b, space.norm(x)};
  std::copy(result, result + kOutcome, task.numbers);
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
  of.active += i * ((size + kChunk - 1) / kChunk);
  all.limits += i * kTolerances;
  all.numbers += i * kOutcome;
  if (all.memory != nullptr) all.memory += i * kVectors * size;
  return all;
}

}  // namespace

template <class T>
void solve(const Pool& pool, Form form, int64_t batch, const Solve<T>& all) {
  if (batch >= pool.threads()) {
    share(pool, batch, [&](int64_t i) { run(OneThread(), form, member(all, form, i)); });
  } else {
    for (int64_t i = 0; i < batch; ++i) run(pool, form, member(all, form, i));
  }
}

template void solve(const Pool&, Form, int64_t, const Solve<float>&);
template void solve(const Pool&, Form, int64_t, const Solve<double>&);

}  // namespace mpmjax
