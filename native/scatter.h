// The scatter, f_i = Σ_p (w_ip a_p + Σ_b g_ip,b a_p,b), and the average: m_i, the last column of a scatter, and its
// other columns divided by m_i, where m_i is more than a least.
//
// It sets the nodes of a range, from all particles in their order; those of a block that follow each other and have the
// same nodes are added up first. Ranges of different threads share no node, so there is no race and nothing to add up
// afterwards, and the sums have the same bits however the nodes are divided. Blocks of nodes that no particle reaches
// are set to zero and not looked at.

#pragma once

#include "block.h"
#include "step.h"
#if defined(__SSE2__)
#include <emmintrin.h>
#endif

namespace {

using mpmjax::Average;
using mpmjax::kChunk;
using mpmjax::P2G;
using mpmjax::Range;
using mpmjax::Scatter;

// Numbers from a first to before a last become zero, or of these only the blocks that are wanted.
template <class T>
void clear(T* numbers, const bool* wanted, int64_t first, int64_t last) {
  if (wanted == nullptr) return void(std::memset(numbers + first, 0, static_cast<size_t>(last - first) * sizeof(T)));
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
  const bool large = size * static_cast<int64_t>(sizeof(T)) > mpmjax::kCached;
  large ? stream(numbers, first, last) : clear(numbers, nullptr, first, last);
}

// The least and the largest of a block's numbers; min_element's search would take branches.
MPMJAX_INLINE Range range_of(const int32_t* least, const int32_t* most, int count) {
  Range range = {least[0], most[0]};
  const auto extend = [&](int count) MPMJAX_INLINE_LAMBDA {
    for (int q = 1; q < count; ++q) range = {std::min(range.least, least[q]), std::max(range.most, most[q])};
  };
  count == kBlock ? extend(kBlock) : extend(count);
  return range;
}

// Marks the blocks of kChunk nodes that a block of particles reaches: for each index of the first axis, from the least to
// the most that the axes after it add, of all particles where they share the index. Several threads mark at a time.
template <class T, int d, int s>
void mark(const Block<T, d, s>& block, int count, int64_t size, bool* reached) {
  const Range beyond = range_of(block.least_beyond, block.most_beyond, count);
  for (int i = 0; i < s; ++i) {
    const BlockInt terms = load_as<BlockInt>(block.index[0][i]);
    const int some = any(terms ^ terms[0]) ? count : 1;
    for (int q = 0; q < some; ++q) {
      const Range after = some == 1 ? beyond : Range{block.least_beyond[q], block.most_beyond[q]};
      const int64_t from = std::max<int64_t>(int64_t(terms[q]) + after.least, 0);
      const int64_t to = std::min<int64_t>(int64_t(terms[q]) + after.most, size - 1);
      for (int64_t k = from / kChunk; from <= to && k <= to / kChunk; ++k) {
        __atomic_store_n(reached + k, true, __ATOMIC_RELAXED);
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

// Columns of the nodes from a first to a last one: all columns, or where `columns` is 0 up to four.
template <class T, int s, int columns>
struct NodeSums {
  using R = RowOf<T, s, columns>;

  T* nodes;  // at the first of the columns
  int64_t row_stride, first, last;
  int64_t extent;  // how many numbers there are from `nodes` to the last of the range
  int used;
  LaneMask<R> present;

  MPMJAX_INLINE NodeSums(T* whole, int64_t c, int64_t column, int64_t first, int64_t last)
      : nodes(whole + column), row_stride(c), first(first), last(last), extent(last * c - column),
        used(smaller(c - column, R::columns)), present(used) {}

  MPMJAX_INLINE int64_t stride() const { return columns == 0 ? row_stride : columns; }

  // Whether any of the nodes from a least to a most may be in the range.
  MPMJAX_INLINE bool may_have(int64_t least, int64_t most) const { return most >= first && least < last; }

  // Whether rows can be added in whole parts for a particle of a block: all that these reach over is in the range, and
  // zeros may be added to what comes after a row.
  template <class B>
  MPMJAX_INLINE bool holds(const B& block, int q) const {
    return block.contiguous[q] && block.least[q] >= first && block.most[q] < last &&
           (block.most[q] - (s - 1)) * stride() + R::reach(stride()) <= extent;
  }

  // Adds to the row of a particle.
  template <bool inside, class B>
  MPMJAX_INLINE void add(const B& block, int row, int q, const R& numbers) const {
    const int32_t node = block.node(row, q);
    if (inside || (block.contiguous[q] && holds_row(node))) {
      T* to = nodes + node * stride();
      const R added = (columns == 0 ? present : LaneMask<R>(columns)).of(numbers);
      // All is read before anything is written: a part's last lanes may be the next one's first, which writes them
      // last.
      const R sums = R::of([&](int k) MPMJAX_INLINE_LAMBDA {
        return load_as<typename R::Part>(to + k * R::together * stride()) + added.parts[k];
      });
      each<R::count>([&](int k) MPMJAX_INLINE_LAMBDA { store(to + k * R::together * stride(), sums.parts[k]); });
    } else {
      const R apart = numbers;  // so that neither the numbers nor what is known of the nodes need a place in memory
      NodeSums(*this).add_apart(block, row, q, apart);
    }
  }

  // The same of the row of nodes that follow one another from this one on.
  MPMJAX_INLINE bool holds_row(int64_t node) const {
    return node >= first && node + s <= last && node * stride() + R::reach(stride()) <= extent;
  }

  // Adds to any nodes, of which those beyond the range are passed over.
  template <class B>
  MPMJAX_NOINLINE void add_apart(const B& block, int row, int q, const R& added) const {
    alignas(R) T numbers[R::count * R::lanes];
    std::memcpy(numbers, &added, sizeof added);
    for (int j = 0; j < s; ++j) {
      const int32_t node = block.node(row, q, j);
      if (node < first || node >= last) continue;
      for (int c = 0; c < used; ++c) nodes[node * stride() + c] += numbers[R::place(j) + c];
    }
  }
};

// What particles with the same nodes give to all rows, in C order of the axes before the last. Gradients are those of
// the axes from a on, without the last.
template <class T, int d, int s, bool graded, int columns>
struct Scatterer {
  using R = RowOf<T, s, columns>;
  static constexpr int last = d - 1, rows = power(s, last);

  const Block<T, d, s>& block;
  R sums[rows] = {};

  // Adds a particle's rows of four. The last axis is the first to be multiplied by, within the row.
  MPMJAX_INLINE void add(int q, const Vector<T> (*values)[kRoom]) {
    const R w = by_node<R>(block.last_weights[q]);
    R value = w * at_each<R>(values[0][q]), gradients[d];
    if constexpr (graded) {
      value = value + by_node<R>(block.last_slopes[q]) * at_each<R>(values[d][q]);
      for (int b = 0; b < last; ++b) gradients[b] = w * at_each<R>(values[b + 1][q]);
    }
    add<0>(q, 0, value, gradients);
  }

  // One step further in: the same times the factors of one node along axis a.
  template <int a>
  MPMJAX_INLINE void add(int q, int row, R value, const R* gradients) {
    if constexpr (a == last) {
      sums[row] = sums[row] + value;
    } else {
      each<s>([&](int i) MPMJAX_INLINE_LAMBDA {
        const T w = block.weights[a][i][q], g = block.slopes[a][i][q];
        R inner[d - a];
        if constexpr (!graded) {
          add<a + 1>(q, s * row + i, w * value, inner);
        } else if constexpr (a + 1 == last) {  // so that both products are added as they are formed
          sums[s * row + i] = sums[s * row + i] + w * value + g * gradients[0];
        } else {
          for (int b = 1; b < last - a; ++b) inner[b - 1] = w * gradients[b];
          add<a + 1>(q, s * row + i, w * value + g * gradients[0], inner);
        }
      });
    }
  }

  // Adds all rows to the nodes of one of the particles.
  template <bool inside>
  MPMJAX_INLINE void put(const NodeSums<T, s, columns>& nodes, int q) const {
#pragma GCC unroll 16
    for (int row = 0; row < rows; ++row) nodes.template add<inside>(block, row, q, sums[row]);
  }
};

// Adds the rows of a block's particles that are taken: a function of its own, for all sums of as many columns.
template <class T, int d, int s, bool graded, int columns>
MPMJAX_NOINLINE void add_rows(const Block<T, d, s>& block, const Vector<T> (*rows)[kRoom], const int* taken, int some,
                              const NodeSums<T, s, columns>& to) {
  const NodeSums<T, s, columns> nodes = to;  // which no store can change
  for (int k = 0; k < some;) {
    Scatterer<T, d, s, graded, columns> scatterer{block};
    const int q = taken[k];
    do {
      scatterer.add(taken[k], rows);
    } while (++k < some && block.same_nodes[taken[k]]);
    nodes.holds(block, q) ? scatterer.template put<true>(nodes, q) : scatterer.template put<false>(nodes, q);
  }
}

// The ranges of all blocks from a first to a last, and where there are so many nodes to mark, those that they reach.
template <class T, int d, int s>
void find_ranges(const Stencils<T>& stencils, int64_t first, int64_t last, Range* ranges, int64_t size, bool* reached) {
  for (int64_t k = first; k < last; ++k) {
    const int count = smaller(stencils.particles - k * kBlock, kBlock);
    Block<T, d, s> block;
    block.find_range(stencils, k * kBlock, count);
    ranges[k] = range_of(block.least, block.most, count);
    if (reached != nullptr) mark<T, d, s>(block, count, size, reached);
  }
}

// Adds what all particles give to a range of nodes, in four columns or fewer. `give(block, start, count, rows)` makes
// it of a block: for each particle the row of its value, and with `graded` then those of its gradients.
template <class T, int d, int s, bool graded, int columns, class Give>
MPMJAX_INLINE void add_blocks(const Stencils<T>& stencils, const Range* ranges, const NodeSums<T, s, columns>& nodes,
                              const Give& give) {
  const int64_t particles = stencils.particles;
  for (int64_t start = 0; start < particles; start += kBlock) {
    if (ranges != nullptr && !nodes.may_have(ranges[start / kBlock].least, ranges[start / kBlock].most)) continue;
    const int count = smaller(particles - start, kBlock);
    Block<T, d, s> block;
    block.find_range(stencils, start, count);
    int taken[kBlock], some = 0;
    for (int q = 0; q < count; ++q) {
      taken[some] = q;
      some += nodes.may_have(block.least[q], block.most[q]) ? 1 : 0;
    }
    if (some == 0) continue;
    block.find_same_nodes();
    for (int pass = 0; pass < passes<d>(stencils); ++pass) {
      block.evaluate(stencils, start, count, differentiated(stencils, pass));
      block.join_last();
      Vector<T> rows[graded ? d + 1 : 1][kRoom];
      give(block, start, count, rows);
      add_rows<T, d, s, graded, columns>(block, rows, taken, some, nodes);
    }
  }
}

// Adds to a range of nodes all columns, or where `columns` is 0 up to four from a first one.
template <class T, int d, int s, bool graded, int columns>
void scatter_columns(const Scatter<T>& task, int64_t column, int64_t first, int64_t last) {
  const int64_t particles = task.stencils.particles;
  const NodeSums<T, s, columns> nodes(task.nodes, task.columns, column, first, last);
  // Of all columns as many as there are of an array, and zeros.
  const auto read = [&](const T* from, int64_t all, int64_t start, int count, Vector<T>* to) MPMJAX_INLINE_LAMBDA {
    if (from == nullptr || column >= all) {
      std::memset(to, 0, kRoom * sizeof *to);
    } else {
      read_rows(from + column * particles + start, particles, count, smaller(all - column, nodes.used), to);
    }
  };
  const auto give = [&](const auto&, int64_t start, int count, auto& rows) MPMJAX_INLINE_LAMBDA {
    read(task.values.value, task.columns, start, count, rows[0]);
    for (int b = 0; b < d && graded; ++b) {
      read(task.values.gradients + b * task.values.graded * particles, task.values.graded, start, count, rows[b + 1]);
    }
  };
  add_blocks<T, d, s, graded, columns>(task.stencils, task.ranges, nodes, give);
}

// Adds to a range of nodes.
template <class T, int d, int s>
void add_all(const Scatter<T>& task, int64_t first, int64_t last) {
  const bool graded = task.values.gradients != nullptr;
  if constexpr (d > 1) {
    if (graded && task.columns == d) return scatter_columns<T, d, s, true, d>(task, 0, first, last);
    if (graded && task.columns == d + 1) return scatter_columns<T, d, s, true, d + 1>(task, 0, first, last);
  }
  for (int64_t c = 0; c < task.columns; c += kLanes) {
    graded ? scatter_columns<T, d, s, true, 0>(task, c, first, last)
           : scatter_columns<T, d, s, false, 0>(task, c, first, last);
  }
}

template <class T, int d, int s>
void scatter(const Scatter<T>& task, int64_t first, int64_t last) {
  const int64_t columns = task.columns;
  over_reached(task.reached, first, last, [&](bool reached, int64_t from, int64_t to) {
    reached ? clear(task.nodes, task.wanted, from * columns, to * columns)
            : wipe(task.nodes, task.size * columns, from * columns, to * columns);
  });
  add_all<T, d, s>(task, first, last);
}

// Of nodes from a first to before a last, all columns, or where `columns` is 0 any number of them.
template <class T, int columns, class Problem>
void divide(const Problem& task, int64_t first, int64_t last) {
  const int64_t c = columns == 0 ? task.columns : columns, others = c - 1;
  const T least = task.least[0];
  for (int64_t i = first; i < last; ++i) {
    const T* sums = task.sums + i * c;
    const bool some = sums[others] > least;
    const T whole = some ? sums[others] : T(1);
    task.whole[i] = some ? whole : T(0);
    for (int64_t k = 0; k < others; ++k) task.means[i * others + k] = some ? sums[k] / whole : T(0);
  }
}

// Sets the nodes of an average, whose sums `add` adds.
template <class T, int d, int s, class Problem, class Add>
MPMJAX_INLINE void average_of(const Problem& task, int64_t first, int64_t last, const Add& add) {
  const int64_t columns = task.columns, others = columns - 1;
  over_reached(task.reached, first, last, [&](bool reached, int64_t from, int64_t to) {
    if (reached) {
      clear(task.sums, nullptr, from * columns, to * columns);
    } else {
      wipe(task.whole, task.size, from, to);
      wipe(task.means, task.size * others, from * others, to * others);
    }
  });
  add();
  over_reached(task.reached, first, last, [&](bool reached, int64_t from, int64_t to) {
    if (!reached) return;
    if (columns == d + 1) return divide<T, d + 1>(task, from, to);
    divide<T, 0>(task, from, to);
  });
}

template <class T, int d, int s>
void average(const Average<T>& task, int64_t first, int64_t last) {
  const Scatter<T> sums = {task.stencils, task.values, task.sums, task.ranges, nullptr, task.size, task.columns, nullptr};
  average_of<T, d, s>(task, first, last, [&] { add_all<T, d, s>(sums, first, last); });
}

template <class T, int d, int s>
void p2g(const P2G<T>& task, int64_t first, int64_t last) {
  using V = Simd<T>;
  const int64_t particles = task.stencils.particles;
  const auto give = [&](const auto& block, int64_t start, int count, auto& rows) MPMJAX_INLINE_LAMBDA {
    for (int k = 0; k < count; k += kSimdLanes<T>) {
      const ParticleLanes<T> lanes(start + k, start + count, particles);
      by_lanes(lanes, [&](auto all) MPMJAX_INLINE_LAMBDA {
        const auto read = [&](const T* array, int row) MPMJAX_INLINE_LAMBDA {
          prefetch(array + row * particles + start + k);
          return lanes.template load<all>(array, row);
        };
        const auto offset = [&](int b) MPMJAX_INLINE_LAMBDA { return load_as<V>(block.offset[b] + k); };
        const auto put = [&](int row, const V* given) MPMJAX_INLINE_LAMBDA { to_rows(given, rows[row] + k); };
        put_rows<d, s, V>(task, offset, read, put);
      });
    }
  };
  average_of<T, d, s>(task, first, last, [&] {
    const NodeSums<T, s, d + 1> nodes(task.sums, d + 1, 0, first, last);
    add_blocks<T, d, s, true, d + 1>(task.stencils, task.ranges, nodes, give);
  });
}

}  // namespace
