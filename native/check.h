// What the checks share: threads, the arrays of a problem, comparisons and the count of faults.

#pragma once

#include <algorithm>
#include <atomic>
#include <cmath>
#include <condition_variable>
#include <cstdio>
#include <cstring>
#include <limits>
#include <memory>
#include <mutex>
#include <random>
#include <string>
#include <thread>
#include <type_traits>
#include <vector>

#include "problems.h"
#include "share.h"

namespace mpmjax {

using Random = std::mt19937;
using Pools = std::vector<const Pool*>;

// A thread for each task.
class Threads : public Pool {
 public:
  explicit Threads(int count) : count_(count) {}
  ~Threads() override {
    std::unique_lock<std::mutex> lock(mutex_);
    ended_.wait(lock, [this] { return running_ == 0; });
  }
  int threads() const override { return count_; }
  void schedule(std::function<void()> task) const override {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      ++running_;
    }
    std::thread([this, task] {
      task();
      const std::lock_guard<std::mutex> lock(mutex_);
      --running_;
      ended_.notify_all();
    }).detach();
  }

 private:
  int count_;
  mutable int running_ = 0;
  mutable std::mutex mutex_;
  mutable std::condition_variable ended_;
};

inline std::atomic<int> faults{0};

inline void expect(bool holds, const std::string& what) {
  if (!holds && ++faults < 20) std::printf("%s\n", what.c_str());
}

// Compares numbers with what they should be, to so many roundings of the largest of these, or of what it is at least.
// What is not finite must be so in both.
template <class T>
void compare(const std::string& what, const T* result, const double* expected, int64_t count, double roundings,
             double largest = 1) {
  for (int64_t i = 0; i < count; ++i) {
    if (std::isfinite(expected[i])) largest = std::max(largest, std::abs(expected[i]));
  }
  const double tolerance = roundings * std::numeric_limits<T>::epsilon() * largest;
  int64_t i = 0;
  const auto right = [&] {
    return std::isfinite(expected[i]) ? std::abs(result[i] - expected[i]) <= tolerance : !std::isfinite(result[i]);
  };
  while (i < count && right()) ++i;
  if (i == count) return;
  expect(false, what + "[" + std::to_string(i) + "] is " + std::to_string(result[i]) +
                    ", expected " + std::to_string(expected[i]));
}

// Nodes along each axis of a window, some of them periodic, and random polynomials.
template <class T>
Basis<T> basis_of(int d, int s, int64_t along, Random random) {
  std::normal_distribution<float> normal;
  Basis<T> basis = {d, s, {}, {}, {}, s + 1, {}, {}, {}};
  for (int64_t a = d - 1, stride = 1; a >= 0; --a, stride *= along) {
    basis.shape[a] = int32_t(along), basis.strides[a] = int32_t(stride), basis.periodic[a] = random() % 4 == 0;
  }
  for (int i = 0; i < s; ++i) {
    basis.knots[i] = normal(random) / 3;
    for (int k = 0; k <= s; ++k) basis.weights[i][k] = normal(random) / 4, basis.slopes[i][k] = normal(random) / 4;
  }
  return basis;
}

// An array that ends where its memory ends.
struct Array {
  std::unique_ptr<char[]> memory;
  int64_t count;
  size_t size;
  bool has_numbers, is_result;

  template <class X>
  X* as() const { return reinterpret_cast<X*>(memory.get()); }
};

// A batch of problems of some sizes with arrays of their own, of random numbers that are exact in single precision.
// There are no marks of blocks.
template <class Problem>
struct Example {
  Problem task;
  int64_t batch;
  std::vector<Array> arrays;

  Example(const Problem& sizes, int64_t batch, Random& random) : task(sizes), batch(batch) {
    std::normal_distribution<float> normal;
    task.arrays([&](auto& array, Lengths shape, bool optional = false) {
      using Element = std::remove_reference_t<decltype(*array)>;
      using X = std::remove_const_t<Element>;
      if (optional && std::is_same_v<X, bool>) return;
      int64_t count = batch;
      for (const Length& n : shape) count *= n.value;
      const size_t size = count * sizeof(X);
      arrays.push_back({std::unique_ptr<char[]>(new char[size]), count, size, std::is_floating_point_v<X>,
                        !std::is_const_v<Element>});
      X* const numbers = arrays.back().template as<X>();
      for (int64_t i = 0; i < count; ++i) {
        numbers[i] = std::is_same_v<X, bool> ? random() % 3 > 0 : std::is_same_v<X, int32_t> ? 0 : X(normal(random));
      }
      array = numbers;
    });
  }

  std::string contents() const {
    std::string bytes;
    for (const Array& array : arrays) bytes.append(array.memory.get(), array.size);
    return bytes;
  }

  // Runs it by every pool, from the same contents: all arrays have the same bits afterwards.
  void run_by_all(const Pools& pools, const std::string& what) const {
    const std::string before = contents();
    std::string first;
    for (const Pool* pool : pools) {
      size_t place = 0;
      for (const Array& to : arrays) before.copy(to.memory.get(), to.size, place), place += to.size;
      run(*pool, batch, task);
      const std::string after = contents();
      if (pool == pools[0]) first = after;
      expect(after == first, what + ": other bits by other threads");
    }
  }
};

// The numbers of an array that a problem only reads, to change them.
template <class T>
T* changed(const T* array) { return const_cast<T*>(array); }

// Passes over arrays and solves, by every pool with the same bits; returns the number of examples.
int check_arrays(const Pools& pools);

}  // namespace mpmjax
