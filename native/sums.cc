#include "sums.h"

#include <algorithm>
#include <memory>
#include <vector>

#include "active.h"
#include "targets.h"

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

int64_t blocks_of(int64_t numbers) { return (numbers + kTogether - 1) / kTogether; }

// The blocks of nodes that are wanted of the i-th member.
const bool* member(const bool* wanted, int64_t i, int64_t numbers) {
  return wanted == nullptr ? nullptr : wanted + i * blocks_of(numbers);
}

template <class T>
Given<T> member(Given<T> all, Form form, int64_t i, int64_t columns, int64_t particles) {
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
  all.given = member(all.given, form, i, all.columns, all.stencils.particles);
  all.wanted = member(all.wanted, i, all.size * all.columns);
  if (all.reached != nullptr) all.reached += i * blocks_of(all.size);
  return all;
}

template <class T>
Average<T> member(Average<T> all, Form form, int64_t i) {
  all.stencils = member(all.stencils, form, i);
  all.given = member(all.given, form, i, all.columns, all.stencils.particles);
  all.least += i;
  all.whole += i * all.size;
  all.means += i * all.size * (all.columns - 1);
  all.sums += i * all.size * all.columns;
  if (all.reached != nullptr) all.reached += i * blocks_of(all.size);
  return all;
}

template <class T>
Pull<T> member(Pull<T> all, Form form, int64_t i) {
  const int64_t factors = i * form.d * form.s * all.stencils.particles;
  all.stencils = member(all.stencils, form, i);
  all.nodes += i * all.size * all.columns;
  all.by_weights += factors;
  all.by_derivatives += factors;
  if (all.value != nullptr) {
    all.value += i * all.columns * all.stencils.particles;
    all.gradients += i * form.d * all.columns * all.stencils.particles;
  }
  all.given = member(all.given, form, i, all.columns, all.stencils.particles);
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
  const int middle = form.s / 2;
  int64_t node = 0;
  for (int a = 0; a < form.d; ++a) {
    if (const Places<T>& places = stencils.places; places.first != nullptr) {
      node += (int64_t(places.first[a * stencils.particles + particle]) + middle) * places.strides[a];
    } else {
      node += stencils.index[(a * form.s + middle) * stencils.particles + particle];
    }
  }
  return node;
}

// Where the nodes are cut into parts with about as many particles each, by a sample: the k-th part goes from the k-th
// number to the next. None cuts a block of kTogether nodes. How well they are chosen changes seconds, never sums.
template <class T>
std::vector<int64_t> cut(const Stencils<T>& stencils, int64_t size, Form form, int64_t parts) {
  const int64_t particles = stencils.particles, samples = std::min(kSamples, particles);
  std::vector<int64_t> places;
  for (int64_t k = 0; parts > 1 && k < samples; ++k) {
    const int64_t middle = middle_node(stencils, form, k * particles / samples);
    if (middle >= 0 && middle < size) places.push_back(middle);
  }
  std::sort(places.begin(), places.end());
  std::vector<int64_t> found = {0};
  for (int64_t k = 1; k < parts; ++k) {
    const int64_t place = places.empty() ? 0 : places[k * places.size() / parts];
    found.push_back(std::max(found.back(), place / kTogether * kTogether));
  }
  found.push_back(size);
  return found;
}

// Calls run(problem, first, last) for the nodes of all members.
template <class Problem, class Run>
void over_nodes(const Pool& pool, Form form, int64_t batch, const Problem& all, const Division& by, const Run& run) {
  share(pool, batch * by.parts, [&](int64_t i) {
    const std::vector<int64_t>& own = by.cuts[i / by.parts];
    const int64_t first = own[i % by.parts], last = own[i % by.parts + 1];
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
  Division found = {shares(pool, form, batch, particles, all.columns, 1), blocks, {}, {}};
  const int64_t parts = found.parts, each = (blocks + parts - 1) / parts;
  found.cuts.assign(batch, {0, all.size});
  if (parts == 1 && !wanted) return found;
  found.ranges.resize(batch * blocks);
  share(pool, batch * parts, [&](int64_t i) {
    const int64_t k = i / parts, first = i % parts * each, last = std::min(blocks, first + each);
    const Stencils<T> stencils = member(all.stencils, form, k);
    if (first < last) kernels.find_ranges(stencils, first, last, found.ranges.data() + k * blocks);
    if (first == 0) found.cuts[k] = cut(stencils, all.size, form, parts);
  });
  return found;
}

template <class T>
bool gather_all(const Pool& pool, Form form, int64_t batch, const Gather<T>& all) {
  const Kernels<T>* found = kernels(T(), form.d, form.s, form.differential);
  if (found == nullptr) return false;
  over_particles(pool, form, batch, all, found->gather);
  return true;
}

template <class T>
bool pull_all(const Pool& pool, Form form, int64_t batch, const Pull<T>& all) {
  const Kernels<T>* found = kernels(T(), form.d, form.s, false);
  if (found == nullptr) return false;
  over_particles(pool, form, batch, all, found->pull);
  return true;
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
bool scatter_all(const Pool& pool, Form form, int64_t batch, const Scatter<T>& all) {
  const Kernels<T>* found = kernels(T(), form.d, form.s, form.differential);
  if (found == nullptr) return false;
  set_nodes(pool, form, batch, all, *found, found->scatter);
  return true;
}

template <class T>
bool average_all(const Pool& pool, Form form, int64_t batch, const Average<T>& all) {
  const Kernels<T>* found = kernels(T(), form.d, form.s, false);
  if (found == nullptr) return false;
  set_nodes(pool, form, batch, all, *found, found->average);
  return true;
}

template <class T>
Division divided_all(const Pool& pool, Form form, int64_t batch, const Resist<T>& all) {
  const Kernels<T>* found = kernels(T(), form.d, form.s, false);
  return found == nullptr ? Division{} : divide(pool, form, batch, all, *found);
}

template <class T>
bool resist_all(const Pool& pool, Form form, int64_t batch, const Resist<T>& all, const Division& division) {
  const Kernels<T>* found = kernels(T(), form.d, form.s, false);
  if (found == nullptr) return false;
  if (reached(division) <= kMostReached) {
    over_nodes(pool, form, batch, all, division, found->resist);
    return true;
  }
  // Each particle once, and then a scatter: the parts would do most particles several times.
  const std::unique_ptr<T[]> stored(new T[batch * form.d * all.columns * all.stencils.particles]);
  Resist<T> first = all;
  first.gradients = stored.get();
  const Given<T> given = {nullptr, stored.get(), all.columns};
  const Scatter<T> rest = {all.stencils, given, all.nodes, nullptr, nullptr, all.size, all.columns, all.wanted};
  over_particles(pool, form, batch, first, found->resist_particles);
  over_nodes(pool, form, batch, rest, division, found->scatter);
  return true;
}

}  // namespace

bool gather(const Pool& p, Form f, int64_t b, const Gather<float>& g) { return gather_all(p, f, b, g); }
bool gather(const Pool& p, Form f, int64_t b, const Gather<double>& g) { return gather_all(p, f, b, g); }
bool scatter(const Pool& p, Form f, int64_t b, const Scatter<float>& s) { return scatter_all(p, f, b, s); }
bool scatter(const Pool& p, Form f, int64_t b, const Scatter<double>& s) { return scatter_all(p, f, b, s); }
bool average(const Pool& p, Form f, int64_t b, const Average<float>& a) { return average_all(p, f, b, a); }
bool average(const Pool& p, Form f, int64_t b, const Average<double>& a) { return average_all(p, f, b, a); }
bool pull(const Pool& p, Form f, int64_t b, const Pull<float>& q) { return pull_all(p, f, b, q); }
bool pull(const Pool& p, Form f, int64_t b, const Pull<double>& q) { return pull_all(p, f, b, q); }
bool resist(const Pool& p, Form f, int64_t b, const Resist<float>& r) { return resist_all(p, f, b, r, divided(p, f, b, r)); }
bool resist(const Pool& p, Form f, int64_t b, const Resist<double>& r) { return resist_all(p, f, b, r, divided(p, f, b, r)); }
Division divided(const Pool& p, Form f, int64_t b, const Resist<float>& r) { return divided_all(p, f, b, r); }
Division divided(const Pool& p, Form f, int64_t b, const Resist<double>& r) { return divided_all(p, f, b, r); }
bool resist(const Pool& p, Form f, int64_t b, const Resist<float>& r, const Division& d) { return resist_all(p, f, b, r, d); }
bool resist(const Pool& p, Form f, int64_t b, const Resist<double>& r, const Division& d) { return resist_all(p, f, b, r, d); }

}  // namespace mpmjax
