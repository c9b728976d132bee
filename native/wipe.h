// Zeros in memory: what is added to next, and what stays empty.

#pragma once

#include <cstring>

#include "problems.h"
#include "vector.h"

#if defined(__SSE2__)
#include <emmintrin.h>
#endif

namespace {

using mpmjax::kCached;
using mpmjax::kChunk;

// Numbers from a first to before a last become zero, or of these only the blocks that are wanted.
template <class T>
void clear(T* numbers, const bool* wanted, int64_t first, int64_t last) {
  if (wanted == nullptr) {
    std::memset(numbers + first, 0, static_cast<size_t>(last - first) * sizeof(T));
    return;
  }
  for (int64_t end, i = first; i < last; i = end) {
    end = (i / kChunk + 1) * kChunk;
    end = end < last ? end : last;
    if (wanted[i / kChunk]) std::memset(numbers + i, 0, static_cast<size_t>(end - i) * sizeof(T));
  }
}

// The same of numbers in an array that is too large for a cache, and which nobody reads soon: they are written past the
// caches, which takes half as long. A cache would first read what is there.
template <class T>
MPMJAX_NOINLINE void stream(T* numbers, int64_t first, int64_t last) {
#if defined(__SSE2__)
  constexpr int64_t kLine = 64, each = kLine / sizeof(T), quarter = each / 4;
  const int64_t into = static_cast<int64_t>(reinterpret_cast<uintptr_t>(numbers + first) % kLine / sizeof(T));
  const int64_t aligned = into == 0 ? first : first + each - into;
  if (aligned + each <= last) {
    clear(numbers, nullptr, first, aligned);
    for (first = aligned; first + each <= last; first += each) {
      for (int64_t i = 0; i < each; i += quarter) {
        _mm_stream_si128(reinterpret_cast<__m128i*>(numbers + first + i), _mm_setzero_si128());
      }
    }
    _mm_sfence();
  }
#endif
  clear(numbers, nullptr, first, last);
}

// Zeros from a first to before a last of so many numbers, which nobody reads soon.
template <class T>
void wipe(T* numbers, int64_t size, int64_t first, int64_t last) {
  if (size * static_cast<int64_t>(sizeof(T)) > kCached) {
    stream(numbers, first, last);
  } else {
    clear(numbers, nullptr, first, last);
  }
}

}  // namespace
