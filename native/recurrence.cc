#include "recurrence.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <memory>
#include <new>

#include "vectors.h"

namespace mpmjax {
namespace {

class OneThread : public Pool {
 public:
  int threads() const override { return 1; }
  void schedule(std::function<void()> task) const override { task(); }
};

struct Freed {
  void operator()(void* memory) const { std::free(memory); }
};

// Zeros. Where they are many, the memory of those that nothing is written to is never touched.
template <class T>
std::unique_ptr<T[], Freed> zeros(int64_t count) {
  T* memory = static_cast<T*>(std::calloc(static_cast<size_t>(std::max<int64_t>(count, 1)), sizeof(T)));
  if (memory == nullptr) throw std::bad_alloc();
  return std::unique_ptr<T[], Freed>(memory);
}

// Calls run(first, last) for the numbers of each active block.
template <class T, class Run>
void over_active(const Recurrence<T>& task, const Run& run) {
  const int64_t size = task.nodes * task.columns, blocks = (size + kTogether - 1) / kTogether;
  for (int64_t k = 0; k < blocks; ++k) {
    if (task.active[k]) run(k * kTogether, std::min(size, (k + 1) * kTogether));
  }
}

template <class T>
bool run(const Pool& pool, Form form, const Recurrence<T>& task) {
  const int64_t size = task.nodes * task.columns;
  // What is not active stays zero, but in the image, where it is never read.
  const auto memory = zeros<T>(5 * size);
  T *const r = memory.get(), *const p = r + size, *const q = p + size, *const moved = q + size, *const image = moved + size;
  over_active(task, [&](int64_t i, int64_t last) { std::copy(task.residual + i, task.residual + last, r + i); });
  if (task.x != task.start) std::memcpy(task.x, task.start, static_cast<size_t>(size) * sizeof(T));
  Resist<T> resistance = {};
  resistance.stencils = task.stencils;
  resistance.matrices = task.matrices;
  resistance.moved = moved;
  resistance.nodes = image;
  resistance.size = task.nodes;
  resistance.columns = task.columns;
  resistance.wanted = task.active;
  const T eps = std::numeric_limits<T>::epsilon();
  T rr = task.limits[3], qq = 0, before = std::numeric_limits<T>::infinity(), radius = 0;
  int64_t steps = 0;
  bool vanished = false, negative = false;
  while (std::sqrt(rr) > task.limits[0] && rr > task.limits[1] && T(steps) < task.limits[2] && !vanished) {
    over_active(task, [&](int64_t i, int64_t last) {
      for (; i < last; ++i) moved[i] = task.free[i] ? r[i] : T(0);
    });
    if (!resist(pool, form, 1, resistance)) return false;
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

template <class T>
Recurrence<T> member(Recurrence<T> all, Form form, int64_t i) {
  const int64_t particles = all.stencils.particles, factors = i * form.d * form.s * particles;
  const int64_t size = all.nodes * all.columns, vectors = i * size;
  all.stencils.index += factors;
  all.stencils.weights += factors;
  all.stencils.derivatives += factors;
  all.matrices += i * form.d * form.d * (form.d * form.d + 1) / 2 * particles;
  all.mass += i * all.nodes;
  all.factor += i;
  all.free += vectors, all.weight += vectors, all.start += vectors, all.residual += vectors, all.x += vectors;
  all.active += i * ((size + kTogether - 1) / kTogether);
  all.limits += i * kLimits;
  all.numbers += i * kNumbers;
  return all;
}

template <class T>
bool recur_all(const Pool& pool, Form form, int64_t batch, const Recurrence<T>& all) {
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

bool recur(const Pool& p, Form f, int64_t b, const Recurrence<float>& r) { return recur_all(p, f, b, r); }
bool recur(const Pool& p, Form f, int64_t b, const Recurrence<double>& r) { return recur_all(p, f, b, r); }

}  // namespace mpmjax
