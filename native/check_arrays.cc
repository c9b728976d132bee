// Checks the passes over arrays: vectors of a solve, decompositions of matrices, and the order of numbers.

#include <numeric>

#include "check.h"
#include "kernels.h"

namespace mpmjax {
namespace {

// Vectors of which some blocks are zero, combined in place and elsewhere; whatever is passed over stays or becomes
// zero.
template <class T>
void check_vectors(int64_t size, bool in_place, std::mt19937& random, const std::vector<const Pool*>& pools) {
  const int64_t batch = 2, blocks = blocks_of(size);
  const Array<T> a(batch * size), b(a.size), c(a.size), d(a.size), weight(a.size), scales(2 * batch), sum(batch);
  const Array<bool> active(batch * blocks);
  for (int64_t i = 0; i < active.size; ++i) active[i] = random() % 3 == 0;
  for (const Array<T>* array : {&a, &b, &c, &d, &weight, &scales}) array->draw(random);
  for (int64_t i = 0; i < a.size; ++i) {
    if (!active[i / size * blocks + i % size / kChunk]) a[i] = b[i] = c[i] = d[i] = 0;
  }
  Expected y(a.size, 30), z(a.size, 30), total(batch, 1);
  for (int64_t i = 0; i < a.size; ++i) {
    y.value[i] = a[i] + double(scales[i / size * 2]) * b[i];
    z.value[i] = c[i] + double(scales[i / size * 2 + 1]) * d[i];
    const double square = weight[i] * z.value[i] * z.value[i];
    total.add(i / size, square, std::abs(square));
  }
  const Array<T> to_y(a.size), to_z(a.size);
  const T *from_b = in_place ? to_y.get() : b.get(), *from_d = in_place ? to_z.get() : d.get();
  by_all(pools, "combinations", [&](const Pool& pool) {
    to_y.fill(7), to_z.fill(7);
    if (in_place) copy(b, to_y), copy(d, to_z);
    combine(pool, batch, Combine<T>{a.get(), from_b, c.get(), from_d, scales.get(), weight.get(), active.get(),
                                    to_y.get(), to_z.get(), sum.get(), size});
  }, to_y, to_z, sum);
  const Shape shape = {1, 0, batch, size, 0, 0};
  compare("combine y", shape, to_y, y);
  compare("combine z", shape, to_z, z);
  compare("combine sum", shape, sum, total);
}

// What is left of a product, in place; nothing is free and all is zero where blocks are passed over.
template <class T>
void check_product(int64_t nodes, int64_t each, std::mt19937& random, const std::vector<const Pool*>& pools) {
  const int64_t batch = 2, size = nodes * each, blocks = blocks_of(size);
  const Array<T> force(batch * size), v(force.size), weight(force.size), mass(batch * nodes), factor(batch), sum(batch);
  const Array<T> to(force.size);
  const Array<bool> active(batch * blocks), free(force.size);
  for (int64_t i = 0; i < active.size; ++i) active[i] = random() % 3 == 0;
  for (const Array<T>* array : {&force, &v, &weight, &mass, &factor}) array->draw(random);
  Expected image(force.size, 1), total(batch, 1);
  for (int64_t i = 0; i < force.size; ++i) {
    const int64_t m = i / size;
    weight[i] = 1 + std::abs(weight[i]);
    if (!active[m * blocks + i % size / kChunk]) { v[i] = 0; continue; }
    free[i] = random() % 3 > 0;
    const double held = mass[m * nodes + i % size / each] * v[i], pushed = double(factor[m]) * force[i];
    const double of_a = free[i] ? held + pushed : double(v[i]);
    image.add(i, of_a / weight[i], std::abs(held) + std::abs(pushed));
    total.add(m, of_a * v[i], image.scale[i] * std::abs(v[i]));
  }
  by_all(pools, "products", [&](const Pool& pool) {
    copy(force, to);
    product(pool, batch, Product<T>{to.get(), v.get(), mass.get(), factor.get(), free.get(), weight.get(), active.get(),
                                    to.get(), sum.get(), size, nodes, true});
  }, to, sum);
  const Shape shape = {1, 0, batch, size, 0, 0};
  compare("product", shape, to, image);
  compare("product's sum", shape, sum, total);
}

// A = V diag(w) Vᵀ and F = R S of random matrices, of all magnitudes, with repeated eigenvalues, of zeros alone. V and
// R are rotations, and S is symmetric. What is not finite spoils its own particle alone.
template <class T>
void check_matrices(int64_t particles, std::mt19937& random, const std::vector<const Pool*>& pools) {
  const int64_t batch = 2, n = particles;
  const Array<T> matrices(batch * 9 * n), values(batch * 3 * n), vectors(matrices.size), rotations(matrices.size);
  std::normal_distribution<T> normal;
  for (int64_t m = 0; m < batch; ++m) {
    for (int64_t k = 0; k < n; ++k) {
      const T size = k % 7 == 6 ? 0 : std::pow(T(10), T(3 * (k % 7 - 3)));
      for (int i = 0; i < 9; ++i) {
        const T repeated = i % 4 == 0 ? 1 : 0;
        matrices[(9 * m + i) * n + k] = size * (k % 3 == 0 ? repeated : normal(random));
      }
      if (k % 11 == 10) matrices[9 * m * n + k] = std::numeric_limits<T>::quiet_NaN();
    }
  }
  const Shape shape = {3, 0, batch, n, 0, 0};
  by_all(pools, "decompositions", [&](const Pool& pool) {
    eigen(pool, batch, Eigen<T>{matrices.get(), values.get(), vectors.get(), n});
    rotation(pool, batch, Rotation<T>{matrices.get(), rotations.get(), n});
  }, values, vectors, rotations);
  // Of what is found: V diag(w) Vᵀ, VᵀV, RᵀR, and RᵀF beside its transpose.
  const Array<T> product(matrices.size), squares(2 * matrices.size), stretch(matrices.size);
  Expected A(matrices.size), one(squares.size, 1), transposed(matrices.size);
  for (int64_t m = 0; m < batch; ++m) {
    for (int64_t k = 0; k < n; ++k) {
      const auto at = [&](int i, int j) { return (9 * m + 3 * i + j) * n + k; };
      double size = 0;
      for (int i = 0; i < 9; ++i) size += std::abs(matrices[at(0, i)]);
      for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) {
          double a = 0, v = 0, r = 0, s = 0, t = 0;
          for (int l = 0; l < 3; ++l) {
            a += double(vectors[at(i, l)]) * values[(3 * m + l) * n + k] * vectors[at(j, l)];
            v += double(vectors[at(l, i)]) * vectors[at(l, j)];
            r += double(rotations[at(l, i)]) * rotations[at(l, j)];
            s += double(rotations[at(l, i)]) * matrices[at(l, j)];
            t += double(rotations[at(l, j)]) * matrices[at(l, i)];
          }
          product[at(i, j)] = T(a), A.add(at(i, j), matrices[i < j ? at(i, j) : at(j, i)], size);
          squares[at(i, j)] = T(v), squares[matrices.size + at(i, j)] = T(r);
          one.value[at(i, j)] = one.value[matrices.size + at(i, j)] = std::isfinite(size) ? i == j : size;
          stretch[at(i, j)] = T(s), transposed.add(at(i, j), t, size);
          if (!std::isfinite(size)) A.value[at(i, j)] = size, squares[at(i, j)] = T(size);  // V may be the identity
        }
      }
    }
  }
  compare("V diag(w) Vt", shape, product, A);
  compare("VtV, RtR", shape, squares, one);
  compare("RtF", shape, stretch, transposed);
}

template <class T>
int check_all(const std::vector<const Pool*>& pools) {
  std::mt19937 random(1);
  int examples = 0;
  for (const int64_t size : {0, 1, 64, 200, 100003}) {
    for (const bool in_place : {false, true}) check_vectors<T>(size, in_place, random, pools), ++examples;
  }
  for (const int64_t nodes : {0, 1, 64, 200, 50003}) {
    for (int each = 1; each <= 3; ++each) check_product<T>(nodes, each, random, pools), ++examples;
  }
  for (const int64_t particles : {0, 1, 16, 53, 9001}) check_matrices<T>(particles, random, pools), ++examples;
  return examples;
}

// Keys of few and of many values, and those that lie farthest apart, against the standard library's stable sort.
int check_order(const std::vector<const Pool*>& pools) {
  std::mt19937 random(1);
  int examples = 0;
  for (const int64_t count : {0, 1, 2, 1000, 70001}) {
    for (const int64_t reach : {int64_t(1), int64_t(30), int64_t(1) << 20, int64_t(1) << 32}) {
      const int64_t batch = 2;
      const Array<int32_t> keys(batch * count), expected(keys.size);
      for (int64_t i = 0; i < keys.size; ++i) keys[i] = static_cast<int32_t>(random() % reach - reach / 2);
      for (int64_t m = 0; m < batch; ++m) {
        int32_t *first = expected.get() + m * count, *last = first + count;
        std::iota(first, last, 0);
        std::stable_sort(first, last, [&](int32_t a, int32_t b) { return keys[m * count + a] < keys[m * count + b]; });
      }
      for (const Pool* pool : pools) {
        const Array<int32_t> result(keys.size);
        order(*pool, batch, Order{keys.get(), result.get(), count});
        expect_same("an order", expected, result);
      }
      ++examples;
    }
  }
  return examples;
}

// Numbers in another order and back, in place and elsewhere, wanted and not, with particles that there are not.
template <class T>
int check_rearrangement(const std::vector<const Pool*>& pools) {
  std::mt19937 random(1);
  int examples = 0;
  for (const int64_t count : {1, 30, 9001}) {
    for (const bool inverse : {false, true}) {
      const int64_t batch = 2, rows = 3, last = count - 1;
      const Array<bool> wanted(batch);
      const Array<int32_t> order(batch * count);
      const Array<T> from(batch * rows * count);
      wanted[1] = true;
      for (int64_t m = 0; m < batch; ++m) {
        std::iota(order.get() + m * count, order.get() + (m + 1) * count, 0);
        std::shuffle(order.get() + m * count, order.get() + (m + 1) * count, random);
      }
      order[count] = std::numeric_limits<int32_t>::max(), order[2 * count - 1] = -7;
      for (int64_t i = 0; i < from.size; ++i) from[i] = T(random() % 1000);
      Array<T> expected(from);
      for (int64_t i = 0; i < rows * count; ++i) {
        const int64_t row = (rows + i / count) * count, k = i % count, other = order[count + k];
        const int64_t clipped = std::min(std::max<int64_t>(other, 0), last);
        if (!inverse) expected[row + k] = from[row + clipped];
        if (inverse && other == clipped) expected[row + other] = from[row + k];
      }
      for (const Pool* pool : pools) {
        for (const bool in_place : {false, true}) {
          const Array<T> source(from), to(from.size);
          T* target = in_place ? source.get() : to.get();
          rearrange(*pool, batch, Rearrangement<T>{wanted.get(), order.get(), source.get(), target, rows,
                                                   count, inverse});
          expect_same("a rearrangement", expected, in_place ? source : to);
        }
      }
      ++examples;
    }
  }
  return examples;
}

}  // namespace

int check_arrays(const std::vector<const Pool*>& pools) {
  return check_all<float>(pools) + check_all<double>(pools) + check_order(pools) + check_rearrangement<float>(pools) +
         check_rearrangement<double>(pools);
}

}  // namespace mpmjax
