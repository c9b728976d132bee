// Checks the passes over arrays: vectors of a solve, solves, decompositions of matrices, and the order of numbers.

#include <array>
#include <numeric>

#include "check.h"
#include "kernels.h"
#include "solve.h"

namespace mpmjax {
namespace {

constexpr int64_t kBatch = 2;

// Numbers of blocks that are not active become zero, or another number.
template <class X>
void clear_inactive(const X* numbers, const bool* active, int64_t size, X other = 0) {
  for (int64_t i = 0; i < kBatch * size; ++i) {
    if (!active[i / size * blocks_of(size) + i % size / kChunk]) changed(numbers)[i] = other;
  }
}

// Combinations of vectors of which some blocks are zero, in place and elsewhere: what is passed over stays or becomes
// zero.
template <class T>
void check_combinations(int64_t size, bool in_place, const Pools& pools) {
  Random random(1);
  Combine<T> sizes = {};
  sizes.size = size;
  Example<Combine<T>> e(sizes, kBatch, random);
  Combine<T>& task = e.task;
  for (const T* vector : {task.a, task.b, task.c, task.d}) clear_inactive(vector, task.active, size);
  std::vector<double> y(kBatch * size), z(y), sum(kBatch);
  for (int64_t i = 0; i < kBatch * size; ++i) {
    const int64_t m = i / size;
    y[i] = task.a[i] + double(task.scales[2 * m]) * task.b[i];
    z[i] = task.c[i] + double(task.scales[2 * m + 1]) * task.d[i];
    sum[m] += task.weight[i] * z[i] * z[i];
  }
  if (in_place) task.y = changed(task.b), task.z = changed(task.d);
  e.run_by_all(pools, "combine");
  compare("y", task.y, y.data(), y.size(), 10);
  compare("z", task.z, z.data(), z.size(), 10);
  compare("a combination's sum", task.sum, sum.data(), kBatch, 1000);
}

// What is left of a product, in place.
template <class T>
void check_products(int64_t nodes, int64_t each, const Pools& pools) {
  Random random(1);
  Product<T> sizes = {};
  sizes.nodes = nodes, sizes.size = nodes * each;
  Example<Product<T>> e(sizes, kBatch, random);
  Product<T>& task = e.task;
  clear_inactive(task.v, task.active, task.size), clear_inactive(task.free, task.active, task.size);
  std::vector<double> image(kBatch * task.size), sum(kBatch);
  for (int64_t i = 0; i < kBatch * task.size; ++i) {
    const int64_t m = i / task.size;
    const double v = task.v[i], held = task.mass[m * nodes + i % task.size / each] * v;
    const double of_a = task.free[i] ? held + double(task.factor[m]) * task.force[i] : v;
    changed(task.weight)[i] = 1 + std::abs(task.weight[i]);
    image[i] = of_a / task.weight[i], sum[m] += of_a * v;
  }
  clear_inactive(image.data(), task.active, task.size);
  task.image = changed(task.force);
  e.run_by_all(pools, "product");
  compare("a product", task.image, image.data(), image.size(), 10);
  compare("a product's sum", task.sum, sum.data(), kBatch, 1000);
}

using Matrix = std::array<double, 9>;

Matrix transposed(const Matrix& a) { return {a[0], a[3], a[6], a[1], a[4], a[7], a[2], a[5], a[8]}; }

Matrix operator*(const Matrix& a, const Matrix& b) {
  Matrix c = {};
  for (int i = 0; i < 27; ++i) c[i / 9 * 3 + i % 3] += a[i / 9 * 3 + i / 3 % 3] * b[i / 3 % 3 * 3 + i % 3];
  return c;
}

// A = V diag(w) Vᵀ and F = R S of random matrices, of all magnitudes, with repeated eigenvalues, of zeros alone. V and
// R are rotations, and S is symmetric. What is not finite spoils its own particle alone.
template <class T>
void check_matrices(int64_t particles, const Pools& pools) {
  Random random(1);
  Eigen<T> eigen_sizes = {};
  Rotation<T> rotation_sizes = {};
  eigen_sizes.particles = rotation_sizes.particles = particles;
  const Example<Eigen<T>> eigen(eigen_sizes, kBatch, random);
  const Example<Rotation<T>> rotation(rotation_sizes, kBatch, random);
  const T* matrices = rotation.task.matrices;
  for (int64_t i = 0; i < kBatch * 9 * particles; ++i) {
    const int64_t k = i % particles, component = i / particles % 9;
    const T size = k % 7 == 6 ? 0 : std::pow(T(10), T(3 * (k % 7 - 3)));
    if (k % 3 == 0) changed(matrices)[i] = component % 4 == 0;
    changed(matrices)[i] = k % 11 == 10 && component == 0 ? NAN : size * matrices[i];
    changed(eigen.task.matrices)[i] = matrices[i];
  }
  eigen.run_by_all(pools, "eigen"), rotation.run_by_all(pools, "rotation");
  for (int64_t i = 0; i < kBatch * particles; ++i) {
    const auto at = [&](const T* from, int rows, int row) {
      return double(from[(i / particles * rows + row) * particles + i % particles]);
    };
    Matrix F, V, R, w = {};
    for (int k = 0; k < 9; ++k) {
      F[k] = at(matrices, 9, k), V[k] = at(eigen.task.vectors, 9, k), R[k] = at(rotation.task.rotations, 9, k);
      if (k % 4 == 0) w[k] = at(eigen.task.values, 3, k / 4);
    }
    if (std::isnan(F[0])) {
      expect(std::isnan(w[0]) && std::isnan(R[0]), "a matrix that is not finite");
      continue;
    }
    const Matrix A = {F[0], F[1], F[2], F[1], F[4], F[5], F[2], F[5], F[8]}, one = {1, 0, 0, 0, 1, 0, 0, 0, 1};
    const Matrix S = transposed(R) * F;
    const double roundings = 64 * std::numeric_limits<T>::epsilon() / std::numeric_limits<double>::epsilon();
    const auto agree = [&](const char* what, const Matrix& result, const Matrix& expected) {
      compare(what, result.data(), expected.data(), 9, roundings, 0);
    };
    agree("V diag(w) Vt", V * w * transposed(V), A);
    agree("VtV", transposed(V) * V, one), agree("RtR", transposed(R) * R, one), agree("RtF", S, transposed(S));
  }
}

// Keys of few and of many values, and those that lie farthest apart, against the standard library's stable sort.
void check_order(int64_t count, int64_t reach, const Pools& pools) {
  Random random(1);
  Order sizes = {};
  sizes.count = count;
  const Example<Order> e(sizes, kBatch, random);
  const int32_t* keys = e.task.keys;
  for (int64_t i = 0; i < kBatch * count; ++i) changed(keys)[i] = static_cast<int32_t>(random() % reach - reach / 2);
  e.run_by_all(pools, "order");
  for (int64_t m = 0; m < kBatch; ++m, keys += count) {
    std::vector<int32_t> expected(count);
    std::iota(expected.begin(), expected.end(), 0);
    std::stable_sort(expected.begin(), expected.end(), [&](int32_t a, int32_t b) { return keys[a] < keys[b]; });
    expect(std::equal(expected.begin(), expected.end(), e.task.order + m * count), "an order");
  }
}

// Numbers in another order and back, in place and elsewhere, wanted and not, with particles that there are not.
template <class T>
void check_rearrangement(int64_t count, bool inverse, bool in_place, const Pools& pools) {
  Random random(1);
  Rearrangement<T> sizes = {};
  sizes.rows = 3, sizes.count = count, sizes.inverse = inverse;
  Example<Rearrangement<T>> e(sizes, kBatch, random);
  Rearrangement<T>& task = e.task;
  int32_t* const order = changed(task.order);
  for (int64_t m = 0; m < kBatch; ++m) {
    std::iota(order + m * count, order + (m + 1) * count, 0);
    std::shuffle(order + m * count, order + (m + 1) * count, random);
    changed(task.wanted)[m] = m == 1;
  }
  order[count] = std::numeric_limits<int32_t>::max(), order[2 * count - 1] = -7;
  std::vector<T> expected(task.from, task.from + kBatch * task.rows * count);
  for (int64_t i = 0; i < task.rows * count; ++i) {
    const int64_t row = (task.rows + i / count) * count, k = i % count, other = order[count + k];
    const int64_t clipped = std::clamp<int64_t>(other, 0, count - 1);
    if (!inverse) expected[row + k] = task.from[row + clipped];
    if (inverse && other == clipped) expected[row + other] = task.from[row + k];
  }
  std::copy_n(task.from, expected.size(), task.to);
  if (in_place) task.to = changed(task.from);
  e.run_by_all(pools, "rearrange");
  expect(std::equal(expected.begin(), expected.end(), task.to), "a rearrangement");
}

// Solves of a batch: ‖r‖ is within its tolerance or the steps are used up, a member that may take no step is left as it
// was, and one that is not finite spoils no other.
template <class T>
void check_solve(int d, int64_t particles, int64_t along, const Pools& pools) {
  constexpr int64_t batch = 3;
  Random random(1);
  std::uniform_real_distribution<T> some(1, 2);
  Solve<T> sizes = {};
  sizes.stencils.basis = basis_of<T>(d, 3, along, random);
  sizes.stencils.particles = particles, sizes.nodes = sizes.stencils.basis.strides[0] * along;
  const int64_t size = sizes.nodes * d, blocks = blocks_of(size);
  for (const int64_t room : {int64_t(0), kVectors * size}) {
    sizes.room = room;
    Example<Solve<T>> e(sizes, batch, random);
    Solve<T>& task = e.task;
    for (int64_t i = 0; i < batch * d * particles; ++i) {
      changed(task.stencils.place)[i] = random() % (along - 2) + some(random) - T(0.5);
    }
    for (int64_t i = 0; i < batch * matrix_entries(d) * particles; ++i) changed(task.matrices)[i] /= 10;
    for (int64_t i = 0; i < batch * task.nodes; ++i) changed(task.mass)[i] = some(random);
    for (int64_t i = 0; i < batch * size; ++i) {
      const bool active = task.active[i / size * blocks + i % size / kChunk];
      changed(task.free)[i] = active && task.free[i], changed(task.weight)[i] = some(random);
      for (const T* vector : {task.start, task.rhs}) changed(vector)[i] = task.free[i] ? some(random) : 0;
    }
    for (int64_t m = 0; m < batch; ++m) {
      const T limits[] = {T(1e-2), T(m == 0 ? 0 : 40), T(1e-10)};
      changed(task.factor)[m] = m + 1 == batch ? NAN : T(0.1) * (m + 1);
      std::copy_n(limits, kTolerances, changed(task.limits) + m * kTolerances);
    }
    for (const Pool* pool : pools) {
      std::fill_n(task.memory, batch * room, NAN);
      run(*pool, batch, task);
      bool fine = task.numbers[1] == 0 && std::equal(task.start, task.start + size, task.x);
      for (int64_t m = 0; m + 1 < batch; ++m) {
        const T *numbers = task.numbers + m * kOutcome, *x = task.x + m * size;
        const bool ended = numbers[1] >= task.limits[m * kTolerances + 1];
        fine = fine && (ended || std::sqrt(numbers[0]) <= T(1e-2) * numbers[7]);
        fine = fine && std::all_of(x, x + size, [](T one) { return std::isfinite(one); });
      }
      expect(fine, "a solve of d = " + std::to_string(d));
    }
  }
}

template <class T>
int check_all(const Pools& pools) {
  int examples = 0;
  for (const int64_t size : {0, 1, 64, 200, 100003}) {
    for (const bool in_place : {false, true}) check_combinations<T>(size, in_place, pools), ++examples;
    for (const int64_t each : {1, 2, 3}) check_products<T>(size / 2, each, pools), ++examples;
  }
  for (const int64_t particles : {0, 1, 16, 53, 9001}) check_matrices<T>(particles, pools), ++examples;
  for (const int64_t count : {1, 30, 9001}) {
    for (const int kind : {0, 1, 2, 3}) check_rearrangement<T>(count, kind % 2, kind / 2, pools), ++examples;
  }
  for (int d = 1; d <= 3; ++d) check_solve<T>(d, 53, 6, pools), ++examples;
  check_solve<T>(2, 20011, 40, pools), ++examples;
  return examples;
}

}  // namespace

int check_arrays(const Pools& pools) {
  int examples = check_all<float>(pools) + check_all<double>(pools);
  for (const int64_t count : {0, 1, 2, 1000, 70001}) {
    for (const int64_t bits : {0, 5, 20, 32}) check_order(count, int64_t(1) << bits, pools), ++examples;
  }
  return examples;
}

}  // namespace mpmjax
