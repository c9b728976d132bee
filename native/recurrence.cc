#include "recurrence.h"

#include <cmath>
#include <limits>

#include "active.h"
#include "vectors.h"

namespace mpmjax {
namespace {

template <class T>
bool run(const Pool& pool, Form form, const Recurrence<T>& task, const Division& division) {
  const int64_t size = task.nodes * task.columns;
  T *const r = task.r, *const p = task.p, *const q = task.q, *const moved = task.moved, *const image = task.image;
  over_active(task.active, size, [&](int64_t i) { p[i] = q[i] = 0; });
  const T eps = std::numeric_limits<T>::epsilon();
  T rr = task.limits[3], qq = 0, before = std::numeric_limits<T>::infinity(), radius = 0;
  int64_t steps = 0;
  bool vanished = false, negative = false;
  while (std::sqrt(rr) > task.limits[0] && rr > task.limits[1] && T(steps) < task.limits[2] && !vanished) {
    over_active(task.active, size, [&](int64_t i) { moved[i] = task.free[i] ? r[i] : T(0); });
    if (!resist(pool, form, 1, resistance(task), division)) return false;
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
  return true;
}

}  // namespace

bool recur(const Pool& p, Form f, const Recurrence<float>& r, const Division& d) { return run(p, f, r, d); }
bool recur(const Pool& p, Form f, const Recurrence<double>& r, const Division& d) { return run(p, f, r, d); }

}  // namespace mpmjax
