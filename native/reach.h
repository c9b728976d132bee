// Which blocks of nodes particles reach, so that others are set to zero and not looked at.

#pragma once

#include "block.h"
#include "wipe.h"

namespace {

using mpmjax::Range;

// Marks the blocks of kChunk nodes, of a range from a first to before a last, that particles reach. Those of a block
// of particles reach, for each index of the first axis, from the least to the most that the axes after it add.
template <class T, int d, int s>
void mark(const Stencils<T>& stencils, const Range* ranges, bool* reached, int64_t first, int64_t last) {
  for (int64_t start = 0; start < stencils.particles; start += kBlock) {
    const Range range = ranges[start / kBlock];
    if (range.most < first || range.least >= last) continue;
    const int count = smaller(stencils.particles - start, kBlock);
    Block<T, d, s> block;
    block.find_range(stencils, start, count);
    int64_t least = block.least_beyond[0], most = block.most_beyond[0];
    for (int q = 1; q < count; ++q) {
      least = block.least_beyond[q] < least ? block.least_beyond[q] : least;
      most = block.most_beyond[q] > most ? block.most_beyond[q] : most;
    }
    for (int i = 0; i < s; ++i) {
      for (int q = 0; q < count; ++q) {
        const int64_t term = block.index[0][i][q];
        if (q > 0 && term == block.index[0][i][q - 1]) continue;
        const int64_t from = term + least < first ? first : term + least, to = term + most < last ? term + most : last - 1;
        for (int64_t k = from / kChunk; from <= to && k <= to / kChunk; ++k) reached[k] = true;
      }
    }
  }
}

// Calls run(whether they are reached, first, last) for nodes of a range, as many together as are alike. Where there
// are no marks, all count as reached.
template <class Run>
void over_reached(const bool* reached, int64_t first, int64_t last, const Run& run) {
  if (reached == nullptr) return run(true, first, last);
  for (int64_t end, start = first; start < last; start = end) {
    const bool alike = reached[start / kChunk];
    int64_t k = start / kChunk + 1;
    while (k * kChunk < last && reached[k] == alike) ++k;
    end = k * kChunk < last ? k * kChunk : last;
    run(alike, start, end);
  }
}

}  // namespace
