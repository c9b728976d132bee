// What the checks share: threads, arrays that end where their memory ends, comparisons and the count of faults.

#pragma once

#include <cmath>
#include <condition_variable>
#include <cstdio>
#include <cstring>
#include <deque>
#include <limits>
#include <memory>
#include <mutex>
#include <thread>
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
  Array(const Array& other) : Array(other.size) { std::memcpy(data.get(), other.data.get(), size * sizeof(T)); }
  T& operator[](int64_t i) const { return data[i]; }
};

struct Shape {
  int d, s;
  int64_t batch, particles, along, columns;
  int64_t size() const { return int64_t(std::pow(along, d) + 0.5); }
};

inline int faults = 0;

template <class T>
void compare(const char* what, const Shape& sh, const Array<T>& result, const std::vector<double>& expected,
             const std::vector<double>& scale) {
  const double tolerance = 64 * std::numeric_limits<T>::epsilon();
  for (int64_t i = 0; i < result.size; ++i) {
    const double error = std::abs(result[i] - expected[i]);
    const bool both = !std::isfinite(expected[i]) && !std::isfinite(result[i]);
    if (both || error <= tolerance * scale[i]) continue;
    if (++faults < 20) {
      std::printf("%s d=%d s=%d columns=%lld particles=%lld: [%lld] is %g, expected %g\n", what, sh.d, sh.s,
                  (long long)sh.columns, (long long)sh.particles, (long long)i, double(result[i]), expected[i]);
    }
    return;
  }
}

template <class T>
void expect_same(const char* what, const Array<T>& one, const Array<T>& other) {
  if (std::memcmp(one.data.get(), other.data.get(), one.size * sizeof(T)) == 0) return;
  if (++faults < 20) std::printf("%s: other bits than expected\n", what);
}

// Passes over arrays, by every pool with the same bits; returns the number of examples.
int check_arrays(const std::vector<const Pool*>& pools);

}  // namespace mpmjax
