// The sums of a batch, on all threads of a pool. Results have the same bits for any number of threads.

#pragma once

#include <algorithm>
#include <cmath>
#include <memory>
#include <vector>

#include "kernels.h"
#include "share.h"

namespace mpmjax {

// A share of the work is worth a thread's attention from so many visits of nodes on, some twenty microseconds.
constexpr int64_t kLeastVisits = 1 << 14;
// Shares of particles for each thread: more than one, so that a thread that another program holds delays little. Nodes
// have one, because what is near a cut is done on both sides of it.
constexpr int64_t kShares = 4;
constexpr int64_t kSamples = 512;
// Ranges of nodes may reach so many times all particles together before a resistance stores what these give.
constexpr double kMostReached = 1.5;
constexpr int64_t kRound = 64;  // particles of a share are a multiple of this: no two write to one line of a cache

// The nodes of each member cut into parts, one for each thread, and the ranges of nodes that its blocks of particles
// reach. Where there is one part there are none, unless they are wanted.
struct Division {
  int64_t parts, blocks;
  std::vector<Range> ranges;
  std::vector<std::vector<int64_t>> cuts;
};

template <class T, template <class> class Problem>
const Kernels<T>& kernels_of(const Problem<T>& all) {
  return *kernels<T>().sums(all.stencils.basis.d, all.stencils.basis.s);
}
template <class Problem>
Kernel<Problem> kernel_of(const Problem& all) {
  return std::get<Kernel<Problem>>(kernels_of(all).sums);
}

// How many shares each problem of a batch is cut into, for so many a thread.
template <class Problem>
int64_t shares(const Pool& pool, int64_t batch, const Problem& all, int64_t each) {
  int64_t visits = all.stencils.particles;
  for (int a = 0; a < all.stencils.basis.d; ++a) visits *= all.stencils.basis.s;
  const int64_t most = pool.threads() > 1 ? (each * pool.threads() + batch - 1) / batch : 1;
  return std::max<int64_t>(1, std::min(visits * ((all.columns + 3) / 4) / kLeastVisits, most));
}

// Runs the kernel of a problem on all particles of all members.
template <class Problem>
void over_particles(const Pool& pool, int64_t batch, const Problem& all) {
  const int64_t particles = all.stencils.particles, each = blocks_of(particles, shares(pool, batch, all, kShares));
  share_parts(pool, batch, particles, std::max<int64_t>(1, blocks_of(each, kRound)) * kRound,
              [&](int64_t m, int64_t first, int64_t last) { kernel_of(all)(member(all, m), first, last); });
}

// Where the nodes are cut into parts with about as many particles each, by a sample: the k-th part goes from the k-th
// number to the next. None cuts a block of kChunk nodes. How well they are chosen changes seconds, never sums.
template <class T>
std::vector<int64_t> cut(const Stencils<T>& stencils, int64_t size, int64_t parts) {
  const int64_t particles = stencils.particles, samples = std::min(kSamples, particles);
  std::vector<int64_t> places;
  for (int64_t k = 0; parts > 1 && k < samples; ++k) {
    int64_t middle = 0;  // the flat index of a node in the middle of a particle's stencil
    for (int a = 0; a < stencils.basis.d; ++a) {
      const T place = stencils.place[a * particles + k * particles / samples];
      middle += std::abs(place) < INT32_MAX ? static_cast<int64_t>(place) * stencils.basis.strides[a] : -size;
    }
    if (middle >= 0 && middle < size) places.push_back(middle);
  }
  std::sort(places.begin(), places.end());
  std::vector<int64_t> result = {0};
  for (int64_t k = 1; k < parts; ++k) {
    const int64_t place = places.empty() ? 0 : places[k * places.size() / parts];
    result.push_back(std::max(result.back(), place / kChunk * kChunk));
  }
  result.push_back(size);
  return result;
}

// Runs the kernel of a problem on the nodes of all members, and then `next`, whoever the member, on those that it set.
template <class Problem, class Next>
void over_nodes(const Pool& pool, int64_t batch, const Problem& all, const Division& by, const Next& next) {
  share(pool, batch * by.parts, [&](int64_t i) {
    const std::vector<int64_t>& cuts = by.cuts[i / by.parts];
    const int64_t first = cuts[i % by.parts], last = cuts[i % by.parts + 1];
    Problem task = member(all, i / by.parts);
    task.ranges = by.ranges.empty() ? nullptr : by.ranges.data() + i / by.parts * by.blocks;
    if (first < last) kernel_of(all)(task, first, last), next(first, last);
  });
}

// How many times the particles of all members are reached by the parts together.
inline double reached(const Division& by) {
  int64_t count = 0;
  for (size_t m = 0; m < by.cuts.size() && !by.ranges.empty(); ++m) {
    for (int64_t k = 0; k < by.blocks; ++k) {
      const Range& range = by.ranges[m * by.blocks + k];
      for (int64_t i = 0; i < by.parts; ++i) count += range.most >= by.cuts[m][i] && range.least < by.cuts[m][i + 1];
    }
  }
  return by.ranges.empty() ? 1 : double(count) / by.ranges.size();
}

// With `reached` the nodes are marked that particles reach, a block of kChunk each.
template <class Problem>
Division divide(const Pool& pool, int64_t batch, const Problem& all, bool* reached = nullptr) {
  const int64_t blocks = blocks_of(all.stencils.particles, kBlock), parts = shares(pool, batch, all, 1);
  Division result = {parts, blocks, {}, {}};
  result.cuts.assign(batch, {0, all.size});
  if (parts == 1 && reached == nullptr) return result;
  result.ranges.resize(batch * blocks);
  share_parts(pool, batch, blocks, std::max<int64_t>(1, blocks_of(blocks, parts)),
              [&](int64_t m, int64_t first, int64_t last) {
    const Problem one = member(all, m);
    bool* marks = reached == nullptr ? nullptr : reached + m * blocks_of(all.size);
    kernels_of(all).find_ranges(one.stencils, first, last, result.ranges.data() + m * blocks, all.size, marks);
    if (first == 0) result.cuts[m] = cut(one.stencils, all.size, parts);
  });
  return result;
}

// Sets all nodes of a scatter or an average. Where they are too many for a cache, those that no particle reaches are
// told.
template <class T, template <class> class Problem>
void set_nodes(const Pool& pool, int64_t batch, Problem<T> all) {
  const bool large = all.size * all.columns * static_cast<int64_t>(sizeof(T)) > kCached;
  const std::unique_ptr<bool[]> reached(large ? new bool[batch * blocks_of(all.size)]() : nullptr);
  all.reached = reached.get();
  over_nodes(pool, batch, all, divide(pool, batch, all, reached.get()), [](int64_t, int64_t) {});
}

template <class T>
void run(const Pool& pool, int64_t batch, const Gather<T>& all) { over_particles(pool, batch, all); }
template <class T>
void run(const Pool& pool, int64_t batch, const Pull<T>& all) { over_particles(pool, batch, all); }
template <class T>
void run(const Pool& pool, int64_t batch, const G2P<T>& all) { over_particles(pool, batch, all); }
template <class T>
void run(const Pool& pool, int64_t batch, const Scatter<T>& all) { set_nodes(pool, batch, all); }
template <class T>
void run(const Pool& pool, int64_t batch, const Average<T>& all) { set_nodes(pool, batch, all); }
template <class T>
void run(const Pool& pool, int64_t batch, const P2G<T>& all) { set_nodes(pool, batch, all); }

// A resistance with a division found before, which its particles' places alone decide, and what is next for its nodes.
template <class T, class Next>
void run(const Pool& pool, int64_t batch, Resist<T> all, const Division& division, const Next& next) {
  if (reached(division) <= kMostReached) return over_nodes(pool, batch, all, division, next);
  // Each particle once, and then a scatter: the parts would do most particles several times.
  const std::unique_ptr<T[]> stored(new T[batch * all.columns * all.columns * all.stencils.particles]);
  const ParticleValues<T> values = {nullptr, stored.get(), all.columns};
  const Scatter<T> rest = {all.stencils, values, all.nodes, nullptr, nullptr, all.size, all.columns, all.wanted};
  all.gradients = stored.get();
  over_particles(pool, batch, all);
  over_nodes(pool, batch, rest, division, next);
}
template <class T>
void run(const Pool& pool, int64_t batch, const Resist<T>& all) {
  run(pool, batch, all, divide(pool, batch, all), [](int64_t, int64_t) {});
}

}  // namespace mpmjax
