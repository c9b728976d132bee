#include "recurrence.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <memory>

#include "vectors.h"

namespace mpmjax {
namespace {

// `to` becomes v in free components. It is zero wherever nothing is active.
template <class T>
void mask(const Recurrence<T>& task, const T* v, T* to) {
  const int64_t size = task.nodes * task.columns, blocks = (size + kTogether - 1) / kTogether;
  for (int64_t k = 0; k < blocks; ++k) {
    if (!task.active[k]) continue;
    const int64_t last = std::min(size, (k + 1) * kTogether);
    for (int64_t i = k * kTogether; i < last; ++i) to[i] = task.free[i] ? v[i] : T(0);
  }
}

template <class T>
bool run(const Pool& pool, Form form, const Recurrence<T>& task) {
  const int64_t size = task.nodes * task.columns;
  const size_t bytes = static_cast<size_t>(size) * sizeof(T);
  const std::unique_ptr<T[]> r(new T[size]), p(new T[size]()), q(new T[size]()), moved(new T[size]()), image(new T[size]);
  std::memcpy(r.get(), task.residual, bytes);
  if (task.x != task.start) std::memcpy(task.x, task.start, bytes);
  Resist<T> resistance = {};
  resistance.stencils = task.stencils;
  resistance.matrices = task.matrices;
  resistance.moved = moved.get();
  resistance.nodes = image.get();
  resistance.size = task.nodes;
  resistance.columns = task.columns;
  const T eps = std::numeric_limits<T>::epsilon();
  T rr = task.limits[3], qq = 0, before = std::numeric_limits<T>::infinity(), radius = 0;
  int64_t steps = 0;
  bool vanished = false, negative = false;
  while (std::sqrt(rr) > task.limits[0] && rr > task.limits[1] && T(steps) < task.limits[2] && !vanished) {
    mask(task, r.get(), moved.get());
    if (!resist(pool, form, 1, resistance)) return false;
    T gamma, square;
    product(pool, 1, Product<T>{image.get(), r.get(), task.mass, task.factor, task.free, task.weight, task.active,
                                image.get(), &gamma, size, task.nodes});
    const T beta = gamma / before, onward[] = {beta, beta};
    combine(pool, 1, Combine<T>{r.get(), p.get(), image.get(), q.get(), onward, task.weight, task.active, p.get(), q.get(),
                                &square, size});
    const T rounding = eps * std::sqrt(rr * (square + beta * beta * qq));  // of γ: ε‖r‖‖s‖
    vanished = std::abs(gamma) <= rounding;
    negative = negative || gamma < -rounding;
    const T alpha = vanished ? T(0) : gamma / square, along[] = {alpha, -alpha};
    const T quotient = std::abs(gamma) / rr;
    if (!(quotient <= radius)) radius = quotient;
    combine(pool, 1, Combine<T>{task.x, p.get(), r.get(), q.get(), along, task.weight, task.active, task.x, r.get(), &rr,
                                size});
    before = gamma, qq = square, ++steps;
  }
  const T numbers[kNumbers] = {rr, T(steps), radius, T(vanished), T(negative)};
  std::copy(numbers, numbers + kNumbers, task.numbers);
  return true;
}

}  // namespace

bool recur(const Pool& p, Form f, const Recurrence<float>& r) { return run(p, f, r); }
bool recur(const Pool& p, Form f, const Recurrence<double>& r) { return run(p, f, r); }

}  // namespace mpmjax
