// Checks the sums against those of one_thread.h in double, on random problems: all dimensions, orders, precisions and
// numbers of columns, batches, periodic axes, indices beyond the window and as large as integers are, places that are
// not finite, no particle and one. Any number of threads must give the same bits. Arrays end where they end, so that a
// sanitizer sees what reads or writes beyond; native/check compiles this with each of them.

#include "check.h"
#include "kernels.h"
#include "one_by_one.h"
#include "sums.h"

using namespace mpmjax;

namespace {

// How the first nodes of particles lie.
enum Places { kInTurn, kByRow, kOneCell, kInside, kAtEdges, kAnywhere };

struct Shape {
  int d, s;
  int64_t batch, particles, along, columns;
  Places places;
  uint32_t seed;
};

std::string name_of(const Shape& sh) {
  std::string name = " of d, s, particles, columns, places";
  for (const int64_t n : {int64_t(sh.d), int64_t(sh.s), sh.particles, sh.columns, int64_t(sh.places)}) {
    name += " " + std::to_string(n);
  }
  return name;
}

template <template <class> class Problem, class T>
Problem<T> sized(const Shape& sh, int64_t columns) {
  Problem<T> task = {};
  task.stencils.basis = basis_of<T>(sh.d, sh.s, sh.along, Random(sh.seed));
  task.stencils.particles = sh.particles;
  task.size = task.stencils.basis.strides[0] * sh.along, task.columns = columns;
  return task;
}

// Places, some of them wild.
template <class T>
void place(const Stencils<T>& stencils, const Shape& sh, Random& random) {
  const auto& basis = stencils.basis;
  const int32_t along = int32_t(sh.along), beyond = sh.places > kInside ? 2 : 0;
  std::uniform_int_distribution<int32_t> inside(-beyond, along - sh.s + beyond), around(-beyond, along - 1 + beyond);
  const int32_t far = sizeof(T) == 8 ? 1 << 30 : 1 << 20;  // where a float has halves still, which a double rounds alike
  std::uniform_int_distribution<int32_t> any(-far, far);
  std::uniform_real_distribution<float> half(-0.5f, 0.5f);
  for (int64_t i = 0; i < sh.batch * sh.d * sh.particles; ++i) {
    const int64_t p = i % sh.particles, side = along - sh.s + 1;
    const int a = int(i / sh.particles % sh.d);
    int64_t in_turn = std::max<int64_t>(p / 2 - (p % 5 == 4), 0);  // two at a place, some beside the one before
    for (int b = sh.d - 1; b > a; --b) in_turn /= side;
    int32_t first = basis.periodic[a] ? around(random) : inside(random);
    if (sh.places == kInTurn) first = int32_t(in_turn % side);
    if (sh.places == kByRow && a == 0) first = int32_t(p * side / sh.particles);
    if (sh.places == kOneCell) first = 0;
    if (sh.places == kAnywhere && p % 7 == 3) first = any(random);
    changed(stencils.place)[i] = sh.places == kAnywhere && i % 97 == 0 ? NAN : first + half(random) + T(sh.s - 1) / 2;
  }
}

// A sum by every pool against that of one_thread.h in double. `set` sets sizes beforehand, `drop` takes arrays away.
// Returns the example.
template <template <class> class Problem, class T, class Set, class Drop>
Example<Problem<T>> check(const std::string& what, const Shape& sh, int64_t columns, const Pools& pools, const Set& set,
                          const Drop& drop) {
  Random random(sh.seed);
  auto sizes = sized<Problem, T>(sh, columns);
  auto in_double = sized<Problem, double>(sh, columns);
  set(sizes), set(in_double);
  Example<Problem<T>> tested(sizes, sh.batch, random);
  place(tested.task.stencils, sh, random);
  // What is not finite, at nodes or of particles; only of NaNs have sums the same bits, however they are divided.
  for (const Array& array : tested.arrays) {
    const bool wild = sh.places == kInTurn || sh.places == kAnywhere;
    if (!wild || array.is_result || !array.has_numbers || array.as<T>() == tested.task.stencils.place) continue;
    const T number = std::is_same_v<Problem<T>, Gather<T>> ? INFINITY : NAN;
    for (int64_t i = 89; i < array.count; i += 997) array.as<T>()[i] = number;
  }
  Example<Problem<double>> expected(in_double, sh.batch, random);
  for (size_t k = 0; k < tested.arrays.size(); ++k) {
    const Array &from = tested.arrays[k], &to = expected.arrays[k];
    if (from.has_numbers) std::copy_n(from.as<T>(), from.count, to.as<double>());
    if (!from.has_numbers) std::copy_n(from.memory.get(), from.size, to.memory.get());
  }
  drop(tested.task), drop(expected.task);
  tested.run_by_all(pools, what + name_of(sh));
  run(OneByOne<0>(), sh.batch, expected.task);
  for (size_t k = 0; k < tested.arrays.size(); ++k) {
    const Array &result = tested.arrays[k], &right = expected.arrays[k];
    if (!result.is_result) continue;
    compare(what + name_of(sh), result.as<T>(), right.as<double>(), right.count, 100 + std::sqrt(sh.particles));
  }
  return tested;
}

// The three sums, of all that may be given: value and gradients, value alone, gradients alone; along dξ; gradients with a
// column less. No gather beside the last pull.
template <class T>
void check_sums(const Shape& sh, const Pools& pools) {
  for (int kind = 0; kind < 5; ++kind) {
    const auto set = [&](auto& task) { task.values.graded = kind == 1 ? 0 : sh.columns - (kind == 4); };
    const auto drop = [&](auto& task) {
      if (kind == 1) task.values.gradients = nullptr;
      if (kind == 2) task.values.value = nullptr;
    };
    const auto drop_change = [&](auto& task) {
      if (kind != 3) task.stencils.change = nullptr;
    };
    check<Gather, T>("gather", sh, sh.columns, pools, [](auto&) {}, drop_change);
    check<Scatter, T>("scatter", sh, sh.columns, pools, set, [&](auto& task) { drop(task), drop_change(task); });
    check<Pull, T>("pull", sh, sh.columns, pools, set, [&](auto& task) {
      drop(task);
      if (kind == 4) task.value = task.gradients = nullptr;
    });
  }
}

// An average, against the scatter of the same: the divided columns have the same bits.
template <class T>
void check_average(const Shape& sh, const Pools& pools) {
  Random random(sh.seed);
  auto sizes = sized<Average, T>(sh, sh.columns);
  sizes.values.graded = sh.columns - 1;
  const Example<Average<T>> e(sizes, sh.batch, random);
  const Average<T>& task = e.task;
  place(task.stencils, sh, random);
  std::fill_n(changed(task.least), sh.batch, T(1e-3));  // in space sums of random polynomials are small
  e.run_by_all(pools, "average" + name_of(sh));
  const int64_t others = sh.columns - 1;
  std::vector<T> nodes(sh.batch * task.size * sh.columns);
  run(*pools[0], sh.batch, Scatter<T>{task.stencils, task.values, nodes.data(), nullptr, nullptr, task.size, sh.columns,
                                      nullptr});
  for (int64_t i = 0; i < sh.batch * task.size; ++i) {
    const T *sums = &nodes[i * sh.columns], *means = task.means + i * others;
    const bool some = sums[others] > task.least[i / task.size];
    bool same = task.whole[i] == (some ? sums[others] : 0);
    for (int64_t k = 0; k < others; ++k) {
      const T mean = some ? sums[k] / sums[others] : 0;
      same = same && (means[k] == mean || (std::isnan(mean) && std::isnan(means[k])));
    }
    expect(same, "average" + name_of(sh));
  }
}

// A resistance, and that of some blocks of nodes, over other numbers.
template <class T>
void check_resistance(const Shape& sh, const Pools& pools) {
  const auto drop = [](auto& task) { task.gradients = nullptr; };
  const auto e = check<Resist, T>("resist", sh, sh.d, pools, [](auto&) {}, drop);
  const int64_t size = e.task.size * sh.d, blocks = blocks_of(size);
  const std::unique_ptr<bool[]> wanted(new bool[sh.batch * blocks]);
  for (int64_t i = 0; i < sh.batch * blocks; ++i) wanted[i] = i % 3 > 0;
  for (const Pool* pool : pools) {
    std::vector<T> some(sh.batch * size, 7);
    Resist<T> part = e.task;
    part.nodes = some.data(), part.wanted = wanted.get();
    run(*pool, sh.batch, part);
    for (int64_t i = 0; i < sh.batch * size; ++i) {
      if (!wanted[i / size * blocks + i % size / kChunk]) some[i] = e.task.nodes[i];
    }
    expect(std::memcmp(some.data(), e.task.nodes, some.size() * sizeof(T)) == 0, "a part of resist" + name_of(sh));
  }
}

// Copies what places particles, to double.
template <class T>
void place_alike(const Stencils<T>& from, const Stencils<double>& to, int64_t batch) {
  std::copy_n(from.place, batch * from.basis.d * from.particles, changed(to.place));
}

// P2G, against an average of what it makes of its arrays.
template <class T>
void check_p2g(const Shape& sh, const Pools& pools) {
  const int d = sh.d, m = d * d;
  const int64_t p = sh.particles;
  for (int kind = 0; kind < 6; ++kind) {  // both terms, C alone, A Bᵀ alone, A alone, q B Bᵀ + r I alone, r I alone
    const bool affine = kind < 2, pushed = kind != 1, isotropic = kind > 3, factored = pushed && kind % 2 == 0;
    Random random(sh.seed);
    Example<P2G<T>> e(sized<P2G, T>(sh, d + 1), sh.batch, random);
    P2G<T>& task = e.task;
    auto sizes = sized<Average, double>(sh, d + 1);
    sizes.values.graded = d;
    const Example<Average<double>> expected(sizes, sh.batch, random);
    const Average<double>& made = expected.task;
    place(task.stencils, sh, random), place_alike(task.stencils, made.stencils, sh.batch);
    for (int64_t b = 0; b < sh.batch; ++b) {
      changed(made.least)[b] = changed(task.least)[b] = 1 + std::abs(task.least[b]);
      changed(task.slope)[b] = 1 + std::abs(task.slope[b]);
    }
    for (int64_t i = 0; i < sh.batch * p; ++i) {
      const int64_t b = i / p;
      const auto at = [&](const auto* array, int64_t rows, int64_t row) -> auto& {
        return changed(array)[(b * rows + row) * p + i % p];
      };
      const double mass = changed(task.mass)[i] = 1 + std::abs(task.mass[i]);
      for (int k = 0; k <= d; ++k) {
        const double push = affine && k < d ? task.push[b * d + k] : 0;
        at(made.values.value, d + 1, k) = k < d ? mass * (at(task.v, d, k) + push) : mass;
      }
      for (int c = 0; c < d; ++c) {
        const double place = at(task.stencils.place, d, c), t = place - std::floor(place) - 0.5;  // of the linear kernel
        const double moment = sh.s == 2 ? 0.25 - t * t : sh.s == 3 ? 1 / 4.0 : 1 / 3.0;
        for (int k = 0; k < d; ++k) {
          double pushes = isotropic && k == c ? task.r[i] : 0;
          for (int l = 0; l < d && pushed; ++l) {
            const auto B = [&](int row) { return factored ? double(at(task.B, m, d * row + l)) : row == l; };
            pushes += (!isotropic ? at(task.A, m, d * k + l) : kind == 4 ? task.q[i] * B(k) : 0) * B(c);
          }
          const double turns = affine ? mass * at(task.C, m, d * k + c) * moment / task.slope[b] : 0;
          at(made.values.gradients, m, d * c + k) = turns + pushes * double(task.factor[b]) * task.slope[b];
        }
      }
    }
    if (!affine) task.C = task.push = nullptr;
    if (!pushed || isotropic) task.A = nullptr;
    if (!factored) task.B = nullptr;
    if (kind != 4) task.q = nullptr;
    if (!isotropic) task.r = nullptr;
    e.run_by_all(pools, "P2G" + name_of(sh));
    run(OneByOne<0>(), sh.batch, made);
    const int64_t nodes = sh.batch * task.size;
    compare("P2G's masses" + name_of(sh), task.whole, made.whole, nodes, 1000);
    compare("P2G" + name_of(sh), task.means, made.means, nodes * d, 1000);
  }
}

// G2P in place, against a gather and what follows from it.
template <class T>
void check_g2p(const Shape& sh, const Pools& pools) {
  Random random(sh.seed);
  const int d = sh.d, m = d * d;
  const int64_t p = sh.particles;
  Example<G2P<T>> e(sized<G2P, T>(sh, d), sh.batch, random);
  G2P<T>& task = e.task;
  const Example<Gather<double>> expected(sized<Gather, double>(sh, d), sh.batch, random);
  Gather<double> gathered = expected.task;
  gathered.stencils.change = nullptr;
  place(task.stencils, sh, random), place_alike(task.stencils, gathered.stencils, sh.batch);
  std::copy_n(task.nodes, sh.batch * task.size * d, changed(gathered.nodes));
  run(OneByOne<0>(), sh.batch, gathered);
  std::vector<double> moved(sh.batch * d * p), gradient(sh.batch * m * p), strained(gradient);
  for (int64_t i = 0; i < sh.batch * m * p; ++i) {
    const int64_t b = i / (m * p), r = i / p % m, at = b * m * p + i % p;
    double change = 0;
    for (int64_t l = 0; l < d; ++l) {
      change += gathered.gradients[at + (l * d + r / d) * p] * task.F[at + (l * d + r % d) * p];
    }
    strained[i] = task.F[i] + double(task.dt[b]) * task.slope[b] * change;
    gradient[i] = task.slope[b] * gathered.gradients[at + (r % d * d + r / d) * p];
  }
  for (size_t i = 0; i < moved.size(); ++i) moved[i] = task.x[i] + double(task.dt[i / (d * p)]) * gathered.value[i];
  task.moved = changed(task.x), task.strained = changed(task.F);
  e.run_by_all(pools, "G2P" + name_of(sh));
  compare("G2P's v" + name_of(sh), task.value, gathered.value, moved.size(), 100);
  compare("G2P's gradient" + name_of(sh), task.gradient, gradient.data(), gradient.size(), 100);
  compare("G2P's x" + name_of(sh), task.moved, moved.data(), moved.size(), 100);
  compare("G2P's F" + name_of(sh), task.strained, strained.data(), strained.size(), 100);
}

template <class T>
int check_all(const Pools& pools) {
  int examples = 0;
  const auto check_one = [&](int d, int s, int64_t batch, int64_t particles, int64_t along, int64_t columns,
                             int places) {
    const Shape sh = {d, s, batch, particles, along, columns, Places(places), uint32_t(++examples)};
    check_sums<T>(sh, pools);
    if (columns > 1) check_average<T>(sh, pools);
    check_resistance<T>(sh, pools);
    if (columns == d) check_p2g<T>(sh, pools), check_g2p<T>(sh, pools);
  };
#if !defined(__SANITIZE_THREAD__)  // which has nothing to see in what one thread does
  for (int d = 1; d <= 3; ++d) {
    for (int s = 2; s <= 4; ++s) {
      for (const int64_t particles : {0, 1, 16, 53}) {
        for (const int64_t columns : {1, 2, 3, 4, 6}) check_one(d, s, 2, particles, 5, columns, examples * 7 % 6);
      }
      for (int64_t columns = 1; columns <= 4; ++columns) check_one(d, s, 1, 1003, 20, columns, kInTurn);
    }
  }
#endif
  // Enough for several threads, and more nodes than a cache holds: those that no particle reaches are marked.
  for (int places = kInTurn; places <= kAnywhere; ++places) check_one(2, 3, 1, 9011, 40, 3, places);
  check_one(3, 3, 1, 103, 60, 3, kInside), check_one(3, 3, 1, 2503, 60, 3, kAnywhere);
  check_one(1, 2, 3, 30011, 999, 1, kAtEdges);
  return examples;
}

}  // namespace

int main() {
  const Threads one(1), two(2), five(5);
  const Pools pools = {&one, &two, &five};
  const int examples = check_all<float>(pools) + check_all<double>(pools) + check_arrays(pools);
  // Several callers at a time, as XLA's, on one pool.
  std::vector<std::thread> callers;
  for (uint32_t i = 0; i < 3; ++i) {
    callers.emplace_back([&, i] {
      const Pools often = {&one, &five, &five, &five, &five, &five};
      check_resistance<float>({2, 3, 1, 9001, 30, 3, kAtEdges, i}, often);
    });
  }
  for (std::thread& caller : callers) caller.join();
  std::printf("%d examples, %s: %d faults\n", examples, instructions(), faults.load());
  return faults == 0 ? 0 : 1;
}
