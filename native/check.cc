// Checks the sums against those of one_thread.h in double, on random problems: all dimensions, orders, precisions and
// numbers of columns, batches, periodic axes, indices beyond the window and as large as integers are, places that are
// not finite, no particle and one. Any number of threads must give the same bits. Arrays end where they end, so that a
// sanitizer sees what reads or writes beyond; native/check compiles this with each of them. What step.h makes of
// particles for both is for tests/test_native.py to check.

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
  // The last result of an average is memory to work in. Others were divided by sums that may be small.
  constexpr bool divides = std::is_same_v<Problem<T>, Average<T>> || std::is_same_v<Problem<T>, P2G<T>>;
  const double roundings = (divides ? 10 : 1) * (100 + std::sqrt(sh.particles));
  for (size_t k = 0; k < tested.arrays.size() - divides; ++k) {
    const Array &result = tested.arrays[k], &right = expected.arrays[k];
    if (result.is_result) compare(what + name_of(sh), result.as<T>(), right.as<double>(), right.count, roundings);
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

// An average, P2G, and G2P, whose results may lie where its operands do.
template <class T>
void check_transfers(const Shape& sh, const Pools& pools) {
  constexpr T kLeast = 1e-3;  // in space sums of random polynomials are small
  const auto set = [&](auto& task) { task.values.graded = sh.columns - 1; };
  const auto choose = [&](auto& task) { std::fill_n(changed(task.least), sh.batch, kLeast); };
  if (sh.columns > 1) check<Average, T>("average", sh, sh.columns, pools, set, choose);
  if (sh.columns != sh.d) return;
  for (int kind = 0; kind < 6; ++kind) {  // both terms, C alone, A Bᵀ alone, A alone, q B Bᵀ + r I alone, r I alone
    check<P2G, T>("P2G", sh, sh.d + 1, pools, [](auto&) {}, [&](auto& task) {
      const int64_t particles = sh.batch * sh.particles;
      choose(task);
      for (int64_t b = 0; b < sh.batch; ++b) changed(task.slope)[b] = 1 + b;
      // Positive, and the same in both precisions.
      for (int64_t i = 0; i < particles; ++i) changed(task.mass)[i] = std::exp2(std::floor(task.mass[i]));
      if (kind > 1) task.C = task.push = nullptr;
      if (kind == 1 || kind > 3) task.A = nullptr;
      if (kind % 2 == 1) task.B = nullptr;
      if (kind != 4) task.q = nullptr;
      if (kind < 4) task.r = nullptr;
    });
  }
  const auto e = check<G2P, T>("G2P", sh, sh.d, pools, [](auto&) {}, [](auto&) {});
  G2P<T> in_place = e.task;
  in_place.moved = changed(in_place.x), in_place.strained = changed(in_place.F);
  run(*pools.back(), sh.batch, in_place);
  const int64_t numbers = sh.batch * sh.d * sh.particles;
  bool same = std::memcmp(in_place.moved, e.task.moved, numbers * sizeof(T)) == 0;
  same = same && std::memcmp(in_place.strained, e.task.strained, numbers * sh.d * sizeof(T)) == 0;
  expect(same, "G2P in place" + name_of(sh));
}

template <class T>
int check_all(const Pools& pools) {
  int examples = 0;
  const auto check_one = [&](int d, int s, int64_t batch, int64_t particles, int64_t along, int64_t columns,
                             int places) {
    const Shape sh = {d, s, batch, particles, along, columns, Places(places), uint32_t(++examples)};
    check_sums<T>(sh, pools);
    check_resistance<T>(sh, pools);
    check_transfers<T>(sh, pools);
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
