#include "sums.h"

#include <algorithm>
#include <vector>

#include "targets.h"

namespace mpmjax {
namespace {

// A share of the work is worth a thread's attention from so many visits of nodes on, some twenty microseconds.
constexpr int64_t kLeastVisits = 1 << 14;
// Shares of particles for each thread: more than one, so that a thread that another program holds delays little. Nodes
// have one, because what is near a cut is done on both sides of it.
constexpr int64_t kShares = 4;
constexpr int64_t kSamples = 512;
constexpr int64_t kRound = 64;  // particles of a share are a multiple of this: no two write to one line of a cache

int64_t power(int64_t base, int exponent) { return exponent == 0 ? 1 : base * power(base, exponent - 1); }

// How many shares each problem of a batch is cut into, for so many a thread.
int64_t shares(const Pool& pool, Form form, int64_t batch, int64_t particles, int64_t columns, int64_t each) {
  const int64_t visits = particles * power(form.s, form.d) * ((columns + 3) / 4);
  const int64_t most = pool.threads() > 1 ? (each * pool.threads() + batch - 1) / batch : 1;
  return std::max<int64_t>(1, std::min(visits / kLeastVisits, most));
}

template <class T>
Stencils<T> member(Stencils<T> all, Form form, int64_t i) {
  const int64_t factors = i * form.d * form.s * all.particles;
  all.index += factors;
  all.weights += factors;
  all.derivatives += factors;
  if (form.differential) {
    all.weight_changes += factors;
    all.derivative_changes += factors;
  }
  return all;
}

template <class T>
void move(T** rows, int64_t by) {
  for (int b = 0; b <= kMostAxes; ++b) {
    if (rows[b] != nullptr) rows[b] += by;
  }
}

template <class T>
Gather<T> member(Gather<T> all, Form form, int64_t i) {
  all.stencils = member(all.stencils, form, i);
  all.nodes += i * all.size * all.columns;
  move(all.sums, i * all.columns * all.stencils.particles);
  return all;
}

template <class T>
Scatter<T> member(Scatter<T> all, Form form, int64_t i) {
  all.stencils = member(all.stencils, form, i);
  all.nodes += i * all.size * all.columns;
  move(all.given, i * all.columns * all.stencils.particles);
  return all;
}

template <class T>
Pull<T> member(Pull<T> all, Form form, int64_t i) {
  const int64_t factors = i * form.d * form.s * all.stencils.particles;
  all.stencils = member(all.stencils, form, i);
  all.nodes += i * all.size * all.columns;
  all.by_weights += factors;
  all.by_derivatives += factors;
  move(all.given, i * all.columns * all.stencils.particles);
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

// Where the nodes are cut into parts with about as many particles each, by a sample: the k-th part goes from the k-th
// number to the next. How well they are chosen changes seconds, never sums.
template <class T>
std::vector<int64_t> cut(const Scatter<T>& task, Form form, int64_t parts) {
  const int64_t particles = task.stencils.particles, samples = std::min(kSamples, particles);
  std::vector<int64_t> places;
  for (int64_t k = 0; parts > 1 && k < samples; ++k) {
    int64_t middle = 0;
    for (int a = 0; a < form.d; ++a) {
      middle += task.stencils.index[(a * form.s + form.s / 2) * particles + k * particles / samples];
    }
    if (middle >= 0 && middle < task.size) places.push_back(middle);
  }
  std::sort(places.begin(), places.end());
  std::vector<int64_t> found = {0};
  for (int64_t k = 1; k < parts; ++k) {
    const int64_t place = places.empty() ? 0 : places[k * places.size() / parts];
    found.push_back(std::max(found.back(), place));
  }
  found.push_back(task.size);
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

template <class T>
bool scatter_all(const Pool& pool, Form form, int64_t batch, const Scatter<T>& all) {
  const Kernels<T>* found = kernels(T(), form.d, form.s, form.differential);
  if (found == nullptr) return false;
  const int64_t particles = all.stencils.particles, blocks = (particles + kBlock - 1) / kBlock;
  const int64_t parts = shares(pool, form, batch, particles, all.columns, 1);
  if (parts == 1) {
    share(pool, batch, [&](int64_t i) { found->scatter(member(all, form, i), 0, all.size); });
    return true;
  }
  std::vector<Range> ranges(batch * blocks);
  std::vector<std::vector<int64_t>> cuts(batch);
  const int64_t each = (blocks + parts - 1) / parts;
  share(pool, batch * parts, [&](int64_t i) {
    const int64_t k = i / parts, first = i % parts * each, last = std::min(blocks, first + each);
    const Scatter<T> task = member(all, form, k);
    if (first < last) found->find_ranges(task.stencils, first, last, ranges.data() + k * blocks);
    if (first == 0) cuts[k] = cut(task, form, parts);
  });
  share(pool, batch * parts, [&](int64_t i) {
    const std::vector<int64_t>& own = cuts[i / parts];
    const int64_t first = own[i % parts], last = own[i % parts + 1];
    Scatter<T> task = member(all, form, i / parts);
    task.ranges = ranges.data() + i / parts * blocks;
    if (first < last) found->scatter(task, first, last);
  });
  return true;
}

}  // namespace

bool gather(const Pool& p, Form f, int64_t b, const Gather<float>& g) { return gather_all(p, f, b, g); }
bool gather(const Pool& p, Form f, int64_t b, const Gather<double>& g) { return gather_all(p, f, b, g); }
bool scatter(const Pool& p, Form f, int64_t b, const Scatter<float>& s) { return scatter_all(p, f, b, s); }
bool scatter(const Pool& p, Form f, int64_t b, const Scatter<double>& s) { return scatter_all(p, f, b, s); }
bool pull(const Pool& p, Form f, int64_t b, const Pull<float>& q) { return pull_all(p, f, b, q); }
bool pull(const Pool& p, Form f, int64_t b, const Pull<double>& q) { return pull_all(p, f, b, q); }

}  // namespace mpmjax
