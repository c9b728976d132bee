// Solves of a batch, on all threads.

#pragma once

#include <cmath>
#include <limits>
#include <memory>
#include <numeric>
#include <vector>

#include "arrays.h"
#include "sums.h"

namespace mpmjax {

class OneThread : public Pool {
 public:
  int threads() const override { return 1; }
  void schedule(std::function<void()> task) const override { task(); }
};

// One solve. What is not active is never read, but of what the resistance moves. Where rows are not free all vectors are
// zero.
template <class T>
class Solver {
 public:
  Solver(const Pool& pool, const Solve<T>& task)
      : pool_(pool), task_(task), size_(task.nodes * task.stencils.basis.d),
        allocated_(task.room == 0 ? new T[kVectors * size_] : nullptr),
        r_(task.room == 0 ? allocated_.get() : task.memory), p_(r_ + size_), q_(p_ + size_), image_(q_ + size_),
        last_(image_ + size_), sums_(blocks_of(task.nodes)) {
    resistance_.stencils = task.stencils, resistance_.matrices = task.matrices;
    resistance_.nodes = image_, resistance_.wanted = task.active;
    resistance_.size = task.nodes, resistance_.columns = task.stencils.basis.d;
    division_ = divide(pool, 1, resistance_);
    std::fill(r_, p_, T(0));
    if (task.x != task.start) std::copy(task.start, task.start + size_, task.x);
  }

  void run() {
    T* const x = task_.x;
    const T b = norm(task_.rhs), tolerance = task_.limits[0] * b, most = task_.limits[1];
    T before = std::numeric_limits<T>::infinity(), change = before;
    bool stalled = false;
    while (true) {
      apply(x);
      rr_ = square([&](int64_t i) { return task_.rhs[i] - image_[i]; }, [&](int64_t i, T v) { r_[i] = v; });
      stalled = rr_ > before / 4, before = rr_;
      if (stalled || vanished_ || !(std::sqrt(rr_) > tolerance) || !(steps_ < most)) break;
      over_active([&](int64_t i) { last_[i] = x[i]; });
      recur(tolerance, task_.limits[2] * rr_, most);
      change = std::sqrt(square([&](int64_t i) { return x[i] - last_[i]; }, [](int64_t, T) {}));
    }
    const T result[kOutcome] = {rr_, steps_, radius_, T(vanished_), T(negative_), change, T(stalled), b, norm(x)};
    std::copy(result, result + kOutcome, task_.numbers);
  }

 private:
  // From x with the residual r: p = r + β p, q = W⁻¹A r + β q, x += α p, r −= α q, while ‖r‖ is above the tolerance,
  // ‖r‖² above the floor, steps are left, and rᵀA r does not vanish to rounding.
  void recur(T tolerance, T floor, T most) {
    T *const x = task_.x, *const r = r_, *const p = p_, *const q = q_;
    over_active([&](int64_t i) { p[i] = q[i] = 0; });
    const T eps = std::numeric_limits<T>::epsilon();
    T qq = 0, radius = 0, before = std::numeric_limits<T>::infinity();
    while (std::sqrt(rr_) > tolerance && rr_ > floor && steps_ < most && !vanished_) {
      const T gamma = apply(r), beta = gamma / before, onward[] = {beta, beta};
      const T square = combine_with(r, p, image_, q, onward, p, q);
      const T rounding = eps * std::sqrt(rr_ * (square + beta * beta * qq));  // of γ: ε‖r‖‖s‖
      vanished_ = std::abs(gamma) <= rounding;
      negative_ = negative_ || gamma < -rounding;
      const T alpha = vanished_ ? T(0) : gamma / square, along[] = {alpha, -alpha};
      const T quotient = std::abs(gamma) / rr_;
      if (!(quotient <= radius)) radius = quotient;
      rr_ = combine_with(x, p, r, q, along, x, r);
      before = gamma, qq = square, ++steps_;
    }
    radius_ = std::max(radius_, radius);
  }

  // W⁻¹A v into the image; returns vᵀA v. A thread goes on with the nodes whose resistance it has summed.
  T apply(const T* v) {
    const Product<T> rest = {image_, v, task_.mass, task_.factor, task_.free, task_.weight, task_.active, image_,
                             nullptr, size_, task_.nodes, false};
    const int64_t d = task_.stencils.basis.d, blocks = blocks_of(size_);
    resistance_.moved = v;
    mpmjax::run(pool_, 1, resistance_, division_, [&](int64_t first, int64_t last) {
      for (int64_t k = first / kChunk; k < blocks_of(last); ++k) {
        sums_[k] = kernels<T>().product(rest, k * d, std::min((k + 1) * d, blocks));
      }
    });
    return static_cast<T>(std::accumulate(sums_.begin(), sums_.end(), 0.0));
  }

  T combine_with(const T* a, const T* b, const T* c, const T* d, const T* scales, T* y, T* z) {
    T result;
    mpmjax::run(pool_, 1, Combine<T>{a, b, c, d, scales, task_.weight, task_.active, y, z, &result, size_});
    return result;
  }

  // Calls run(i) for all numbers of the active blocks.
  template <class Run>
  void over_active(const Run& run) const {
    for (int64_t first = 0, k = 0; first < size_; first += kChunk, ++k) {
      if (!task_.active[k]) continue;
      const int64_t last = std::min(size_, first + kChunk);
      for (int64_t i = first; i < last; ++i) run(i);
    }
  }

  // ‖v‖² with v_i = value(i), each handed to put(i, v_i). The sum is that of products in double.
  template <class Value, class Put>
  T square(const Value& value, const Put& put) const {
    double sum = 0;
    over_active([&](int64_t i) {
      const T v = value(i);
      put(i, v);
      sum += static_cast<double>(task_.weight[i] * v) * v;
    });
    return static_cast<T>(sum);
  }

  T norm(const T* v) const {
    return std::sqrt(square([&](int64_t i) { return v[i]; }, [](int64_t, T) {}));
  }

  const Pool& pool_;
  const Solve<T>& task_;
  const int64_t size_;
  const std::unique_ptr<T[]> allocated_;
  T *const r_, *const p_, *const q_, *const image_, *const last_;
  std::vector<double> sums_;  // of vᵀA v, for each block of kChunk nodes
  Resist<T> resistance_ = {};
  Division division_;
  T rr_ = 0, steps_ = 0, radius_ = 0;
  bool vanished_ = false, negative_ = false;
};

// Each ends by itself. As many as there are threads or more are shared among them whole, each with its arrays in the
// cache of one core; fewer are done one by one by all threads.
template <class T>
void run(const Pool& pool, int64_t batch, const Solve<T>& all) {
  if (batch >= pool.threads()) {
    share(pool, batch, [&](int64_t i) { Solver<T>(OneThread(), member(all, i)).run(); });
  } else {
    for (int64_t i = 0; i < batch; ++i) Solver<T>(pool, member(all, i)).run();
  }
}

}  // namespace mpmjax
