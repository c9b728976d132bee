#include "sums.h"

#include <algorithm>
#include <memory>
#include <vector>

#include "active.h"
#include "instructions.h"

namespace mpmjax {
namespace {

// A share of the work is worth a thread's attention from so many visits of nodes on, some twenty microseconds.
constexpr int64_t kLeastVisits = 1 << 14;
// Shares of particles for each thread: more than one, so that a thread that another program holds delays little. Nodes
// have one, because what is near a cut is done on both sides of it.
constexpr int64_t kShares = 4;
constexpr int64_t kSamples = 512;
// Ranges of nodes may reach so many times all particles together before a resistance stores what these give.
constexpr double kMostReached = 1.5;
constexpr int64_t kRound = 64;  // particles of a share are a multiple of this: no two write to one line of a cache

int64_t power(int64_t base, int exponent) { return exponent == 0 ? 1 : base * power(base, exponent - 1); }

// How many shares each problem of a batch is cut into, for so many a thread.
int64_t shares(const Pool& pool, Form form, int64_t batch, int64_t particles, int64_t columns, int64_t each) {
  const int64_t visits = particles * power(form.s, form.d) * ((columns + 3) / 4);
  const int64_t most = pool.threads() > 1 ? (each * pool.threads() + batch - 1) / batch : 1;
  return std::max<int64_t>(1, std::min(visits / kLeastVisits, most));
}

int64_t blocks_of(int64_t numbers) { return (numbers + kChunk - 1) / kChunk; }

// The blocks of nodes that are wanted of the i-th member.
const bool* member(const bool* wanted, int64_t i, int64_t numbers) {
  return wanted == nullptr ? nullptr : wanted + i * blocks_of(numbers);
}

template <class T>
ParticleValues<T> member(ParticleValues<T> all, Form form, int64_t i, int64_t columns, int64_t particles) {
  if (all.value != nullptr) all.value += i * columns * particles;
  if (all.gradients != nullptr) all.gradients += i * form.d * all.graded * particles;
  return all;
}

template <class T>
Gather<T> member(Gather<T> all, Form form, int64_t i) {
  all.stencils = member(all.stencils, form, i);
  all.nodes += i * all.size * all.columns;
  all.value += i * all.columns * all.stencils.particles;
  all.gradients += i * form.d * all.columns * all.stencils.particles;
  return all;
}

template <class T>
Scatter<T> member(Scatter<T> all, Form form, int64_t i) {
  all.stencils = member(all.stencils, form, i);
  all.nodes += i * all.size * all.columns;
  all.values = member(all.values, form, i, all.columns, all.stencils.particles);
  all.wanted = member(all.wanted, i, all.size * all.columns);
  if (all.reached != nullptr) all.reached += i * blocks_of(all.size);
  return all;
}

template <class T>
Average<T> member(Average<T> all, Form form, int64_t i) {
  all.stencils = member(all.stencils, form, i);
  all.values = member(all.values, form, i, all.columns, all.stencils.particles);
  all.least += i;
  all.whole += i * all.size;
  all.means += i * all.size * (all.columns - 1);
  all.sums += i * all.size * all.columns;
  if (all.reached != nullptr) all.reached += i * blocks_of(all.size);
  return all;
}

template <class T>
Pull<T> member(Pull<T> all, Form form, int64_t i) {
  all.stencils = member(all.stencils, form, i);
  all.nodes += i * all.size * all.columns;
  all.by_offset += i * form.d * all.stencils.particles;
  if (all.value != nullptr) {
    all.value += i * all.columns * all.stencils.particles;
    all.gradients += i * form.d * all.columns * all.stencils.particles;
  }
  all.values = member(all.values, form, i, all.columns, all.stencils.particles);
  return all;
}

template <class T>
Resist<T> member(Resist<T> all, Form form, int64_t i) {
  all.stencils = member(all.stencils, form, i);
  all.matrices += i * form.d * form.d * (form.d * form.d + 1) / 2 * all.stencils.particles;
  all.moved += i * all.size * all.columns;
  all.nodes += i * all.size * all.columns;
  if (all.gradients != nullptr) all.gradients += i * form.d * all.columns * all.stencils.particles;
  all.wanted = member(all.wanted, i, all.size * all.columns);
  return all;
}

// Calls run(problem, first, last) for all particles of all members.
template <class Problem, class Run>
void over_particles(const Pool& pool, Form form, int64_t batch, const Problem& all, const Run& run) {
  const int64_t particles = all.stencils.particles;
  const int64_t parts = shares(pool, form, batch, particles, all.columns, kShares);
  const int64_t each = ((particles + parts - 1) / parts + kRound - 1) / kRound * kRound;
  share(pool, batch * parts, [&](int64_t i) {
    const int64_t first = i % parts * each, last = std::min(particles, first + each);
    if (first < last) run(member(all, form, i / parts), first, last);
  });
}

// The flat index of a node in the middle of a particle's stencil.
template <class T>
int64_t middle_node(const Stencils<T>& stencils, Form form, int64_t particle) {
  int64_t node = 0;
  for (int a = 0; a < form.d; ++a) {
    const int64_t first = stencils.first[a * stencils.particles + particle];
    node += (first + form.s / 2) * stencils.basis.strides[a];
  }
  return node;
}

// Where the nodes are cut into parts with about as many particles each, by a sample: the k-th part goes from the k-th
// number to the next. None cuts a block of kChunk nodes. How well they are chosen changes seconds, never sums.
template <class T>
std::vector<int64_t> cut(const Stencils<T>& stencils, int64_t size, Form form, int64_t parts) {
  const int64_t particles = stencils.particles, samples = std::min(kSamples, particles);
  std::vector<int64_t> places;
  for (int64_t k = 0; parts > 1 && k < samples; ++k) {
    const int64_t middle = middle_node(stencils, form, k * particles / samples);
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

// Calls run(problem, first, last) for the nodes of all members.
template <class Problem, class Run>
void over_nodes(const Pool& pool, Form form, int64_t batch, const Problem& all, const Division& by, const Run& run) {
  share(pool, batch * by.parts, [&](int64_t i) {
    const std::vector<int64_t>& cuts = by.cuts[i / by.parts];
    const int64_t first = cuts[i % by.parts], last = cuts[i % by.parts + 1];
    Problem task = member(all, form, i / by.parts);
    task.ranges = by.ranges.empty() ? nullptr : by.ranges.data() + i / by.parts * by.blocks;
    if (first < last) run(task, first, last);
  });
}

// How many times the particles of all members are reached by the parts together.
double reached(const Division& by) {
  int64_t count = 0;
  for (size_t m = 0; m < by.cuts.size() && !by.ranges.empty(); ++m) {
    for (int64_t k = 0; k < by.blocks; ++k) {
      const Range& range = by.ranges[m * by.blocks + k];
      for (int64_t i = 0; i < by.parts; ++i) count += range.most >= by.cuts[m][i] && range.least < by.cuts[m][i + 1];
    }
  }
  return by.ranges.empty() ? 1 : double(count) / by.ranges.size();
}

template <class T, class Problem>
Division divide(const Pool& pool, Form form, int64_t batch, const Problem& all, const Kernels<T>& kernels,
                bool wanted = false) {
  const int64_t particles = all.stencils.particles, blocks = (particles + kBlock - 1) / kBlock;
  Division result = {shares(pool, form, batch, particles, all.columns, 1), blocks, {}, {}};
  const int64_t parts = result.parts, each = (blocks + parts - 1) / parts;
  result.cuts.assign(batch, {0, all.size});
  if (parts == 1 && !wanted) return result;
  result.ranges.resize(batch * blocks);
  share(pool, batch * parts, [&](int64_t i) {
    const int64_t k = i / parts, first = i % parts * each, last = std::min(blocks, first + each);
    const Stencils<T> stencils = member(all.stencils, form, k);
    if (first < last) kernels.find_ranges(stencils, first, last, result.ranges.data() + k * blocks);
    if (first == 0) result.cuts[k] = cut(stencils, all.size, form, parts);
  });
  return result;
}

// Sets all nodes of a scatter or an average. Where they are too many for a cache, those that no particle reaches are told.
template <class T, class Problem>
void set_nodes(const Pool& pool, Form form, int64_t batch, Problem all, const Kernels<T>& kernels,
               void (*run)(const Problem&, int64_t, int64_t)) {
  const bool large = all.size * all.columns * static_cast<int64_t>(sizeof(T)) > kCached;
  const Vectors<bool> reached = large ? zeros<bool>(batch * blocks_of(all.size)) : nullptr;
  all.reached = reached.get();
  over_nodes(pool, form, batch, all, divide(pool, form, batch, all, kernels, large), run);
}

template <class T>
const Kernels<T>& kernels_of(Form form) {
  return *kernels<T>().sums(form.d, form.s);
}

}  // namespace

template <class T>
void gather(const Pool& pool, Form form, int64_t batch, const Gather<T>& all) {
  over_particles(pool, form, batch, all, kernels_of<T>(form).gather);
}

template <class T>
void pull(const Pool& pool, Form form, int64_t batch, const Pull<T>& all) {
  over_particles(pool, form, batch, all, kernels_of<T>(form).pull);
}

template <class T>
void scatter(const Pool& pool, Form form, int64_t batch, const Scatter<T>& all) {
  set_nodes(pool, form, batch, all, kernels_of<T>(form), kernels_of<T>(form).scatter);
}

template <class T>
void average(const Pool& pool, Form form, int64_t batch, const Average<T>& all) {
  set_nodes(pool, form, batch, all, kernels_of<T>(form), kernels_of<T>(form).average);
}

template <class T>
Division divided(const Pool& pool, Form form, int64_t batch, const Resist<T>& all) {
  return divide(pool, form, batch, all, kernels_of<T>(form));
}

template <class T>
void resist(const Pool& pool, Form form, int64_t batch, const Resist<T>& all, const Division& division) {
  const Kernels<T>& kernels = kernels_of<T>(form);
  if (reached(division) <= kMostReached) return over_nodes(pool, form, batch, all, division, kernels.resist);
  // Each particle once, and then a scatter: the parts would do most particles several times.
  const std::unique_ptr<T[]> stored(new T[batch * form.d * all.columns * all.stencils.particles]);
  Resist<T> first = all;
  first.gradients = stored.get();
  const ParticleValues<T> values = {nullptr, stored.get(), all.columns};
  const Scatter<T> rest = {all.stencils, values, all.nodes, nullptr, nullptr, all.size, all.columns, all.wanted};
  over_particles(pool, form, batch, first, kernels.resist_particles);
  over_nodes(pool, form, batch, rest, division, kernels.scatter);
}

#define MPMJAX_SUMS(T)                                                        \
  template void gather(const Pool&, Form, int64_t, const Gather<T>&);         \
  template void scatter(const Pool&, Form, int64_t, const Scatter<T>&);       \
  template void average(const Pool&, Form, int64_t, const Average<T>&);       \
  template void pull(const Pool&, Form, int64_t, const Pull<T>&);             \
  template Division divided(const Pool&, Form, int64_t, const Resist<T>&);    \
  template void resist(const Pool&, Form, int64_t, const Resist<T>&, const Division&);
MPMJAX_SUMS(float)
MPMJAX_SUMS(double)

}  // namespace mpmjax
