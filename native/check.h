// What the checks share: threads, arrays that end where their memory ends, comparisons and the count of faults.

#pragma once

#include <algorithm>
#include <cmath>
#include <condition_variable>
#include <cstdio>
#include <cstring>
#include <deque>
#include <limits>
#include <memory>
#include <mutex>
#include <random>
#include <thread>
#include <tuple>
#include <vector>

#include "share.h"

namespace mpmjax {

class Threads : public Pool {
 public:
  explicit Threads(int count) : count_(count) {
    for (int i = 1; i < count; ++i) threads_.emplace_back([this] { work(); });
  }
  ~Threads() override {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      ended_ = true;
    }
    changed_.notify_all();
    for (std::thread& thread : threads_) thread.join();
  }
  int threads() const override { return count_; }
  void schedule(std::function<void()> task) const override {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      tasks_.push_back(std::move(task));
    }
    changed_.notify_one();
  }

 private:
  void work() {
    for (;;) {
      std::unique_lock<std::mutex> lock(mutex_);
      changed_.wait(lock, [this] { return ended_ || !tasks_.empty(); });
      if (ended_) return;
      const std::function<void()> task = std::move(tasks_.front());
      tasks_.pop_front();
      lock.unlock();
      task();
    }
  }

  int count_;
  bool ended_ = false;
  mutable std::mutex mutex_;
  mutable std::condition_variable changed_;
  mutable std::deque<std::function<void()>> tasks_;
  std::vector<std::thread> threads_;
};

// Numbers that end where their memory ends.
template <class T>
struct Array {
  std::unique_ptr<T[]> data;
  int64_t size;
  explicit Array(int64_t n) : data(new T[n]()), size(n) {}
  Array(const Array& other) : Array(other.size) { std::copy(other.get(), other.get() + size, get()); }
  T* get() const { return data.get(); }
  void fill(T value) const { std::fill(get(), get() + size, value); }
  template <class Random>
  void draw(Random& random) const {
    std::normal_distribution<T> normal;
    std::generate(get(), get() + size, [&] { return normal(random); });
  }
  T& operator[](int64_t i) const { return data[i]; }
};

struct Shape {
  int d, s;
  int64_t batch, particles, along, columns;
  int64_t size() const { return int64_t(std::pow(along, d) + 0.5); }
};

inline int faults = 0;

// What numbers should be, and what bounds their rounding.
struct Expected {
  std::vector<double> value, scale;
  explicit Expected(int64_t size, double least = 0) : value(size), scale(size, least) {}
  void add(int64_t at, double term, double bound) { value[at] += term, scale[at] += bound; }
};

template <class T>
void compare(const char* what, const Shape& sh, const Array<T>& result, const Expected& expected) {
  const double tolerance = 64 * std::numeric_limits<T>::epsilon();
  for (int64_t i = 0; i < result.size; ++i) {
    const double value = expected.value[i], error = std::abs(result[i] - value);
    const bool both = !std::isfinite(value) && !std::isfinite(result[i]);
    if (both || error <= tolerance * expected.scale[i]) continue;
    if (++faults < 20) {
      std::printf("%s d=%d s=%d columns=%lld particles=%lld: [%lld] is %g, expected %g\n", what, sh.d, sh.s,
                  (long long)sh.columns, (long long)sh.particles, (long long)i, double(result[i]), value);
    }
    return;
  }
}

template <class T>
void copy(const Array<T>& from, const Array<T>& to) {
  std::copy(from.get(), from.get() + from.size, to.get());
}

template <class T>
void expect_same(const char* what, const Array<T>& one, const Array<T>& other) {
  if (std::memcmp(one.get(), other.get(), one.size * sizeof(T)) == 0) return;
  if (++faults < 20) std::printf("%s: other bits than expected\n", what);
}

// Calls run(pool) for each pool, after which the results have the same bits as with the first one.
template <class Run, class... Arrays>
void by_all(const std::vector<const Pool*>& pools, const char* what, const Run& run, const Arrays&... results) {
  std::tuple<Arrays...> first(results...);
  for (const Pool* pool : pools) {
    run(*pool);
    if (pool == pools[0]) std::apply([&](Arrays&... kept) { (copy(results, kept), ...); }, first);
    std::apply([&](const Arrays&... kept) { (expect_same(what, kept, results), ...); }, first);
  }
}

// Passes over arrays, by every pool with the same bits; returns the number of examples.
int check_arrays(const std::vector<const Pool*>& pools);

}  // namespace mpmjax
