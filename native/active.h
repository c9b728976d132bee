// Vectors that may differ from zero in some blocks of 64 numbers alone.

#pragma once

#include <algorithm>
#include <cstdlib>
#include <memory>
#include <new>

#include "problems.h"

namespace mpmjax {

struct Freed {
  void operator()(void* memory) const { std::free(memory); }
};

template <class T>
using Vectors = std::unique_ptr<T[], Freed>;

// Zeros. The system gives their memory page by page when it is first written to. For large arrays that are written in
// each step take memory of XLA, which keeps it from step to step.
template <class T>
Vectors<T> zeros(int64_t count) {
  T* memory = static_cast<T*>(std::calloc(static_cast<size_t>(std::max<int64_t>(count, 1)), sizeof(T)));
  if (memory == nullptr) throw std::bad_alloc();
  return Vectors<T>(memory);
}

// Calls run(i) for all numbers of the active blocks.
template <class Run>
void over_active(const bool* active, int64_t size, const Run& run) {
  for (int64_t first = 0, k = 0; first < size; first += kChunk, ++k) {
    if (!active[k]) continue;
    const int64_t last = std::min(size, first + kChunk);
    for (int64_t i = first; i < last; ++i) run(i);
  }
}

}  // namespace mpmjax
