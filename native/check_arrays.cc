// Checks the passes over arrays: vectors of a solve, decompositions of matrices, and the order of numbers.

#include <algorithm>
#include <numeric>
#include <random>

#include "check.h"
#include "matrices.h"
#include "order.h"
#include "vectors.h"

namespace mpmjax {
namespace {

// Vectors of which some blocks are zero, combined in place and elsewhere; whatever is passed over stays or becomes zero.
template <class T>
void check_vectors(int64_t size, bool in_place, std::mt19937& random, const std::vector<const Pool*>& pools) {
  const int64_t batch = 2, blocks = (size + kChunk - 1) / kChunk;
  std::normal_distribution<T> normal;
  const Array<T> a(batch * size), b(a.size), c(a.size), d(a.size), weight(a.size), scales(2 * batch), sum(batch);
  const Array<bool> active(batch * blocks);
  for (int64_t i = 0; i < active.size; ++i) active[i] = random() % 3 == 0;
  for (int64_t i = 0; i < a.size; ++i) {
    weight[i] = normal(random);
    if (!active[i / size * blocks + i % size / kChunk]) continue;
    a[i] = normal(random), b[i] = normal(random), c[i] = normal(random), d[i] = normal(random);
  }
  for (int64_t i = 0; i < scales.size; ++i) scales[i] = normal(random);
  std::vector<double> y(a.size), z(a.size), total(batch), ones(a.size, 30), bound(batch, 1);
  for (int64_t i = 0; i < a.size; ++i) {
    y[i] = a[i] + double(scales[i / size * 2]) * b[i];
    z[i] = c[i] + double(scales[i / size * 2 + 1]) * d[i];
    total[i / size] += weight[i] * z[i] * z[i];
    bound[i / size] += std::abs(weight[i] * z[i] * z[i]);
  }
  std::unique_ptr<Array<T>> bits;
  for (const Pool* pool : pools) {
    Array<T> to_y(in_place ? b : a), to_z(in_place ? d : c);
    for (int64_t i = 0; i < to_y.size && !in_place; ++i) to_y[i] = to_z[i] = 7;
    combine(*pool, batch, Combine<T>{a.data.get(), in_place ? to_y.data.get() : b.data.get(), c.data.get(),
                                     in_place ? to_z.data.get() : d.data.get(), scales.data.get(), weight.data.get(),
                                     active.data.get(), to_y.data.get(), to_z.data.get(), sum.data.get(), size});
    const Shape shape = {1, 0, batch, size, 0, 0};
    compare("combine y", shape, to_y, y, ones);
    compare("combine z", shape, to_z, z, ones);
    compare("combine sum", shape, sum, total, bound);
    if (bits == nullptr) bits = std::make_unique<Array<T>>(sum);
    expect_same("a norm", *bits, sum);
  }
}

// What is left of a product, in place; nothing is free and all is zero where blocks are passed over.
template <class T>
void check_product(int64_t nodes, int64_t each, std::mt19937& random, const std::vector<const Pool*>& pools) {
  const int64_t batch = 2, size = nodes * each, blocks = (size + kChunk - 1) / kChunk;
  std::normal_distribution<T> normal;
  const Array<T> force(batch * size), v(force.size), weight(force.size), mass(batch * nodes), factor(batch), sum(batch);
  const Array<bool> active(batch * blocks), free(force.size);
  for (int64_t i = 0; i < active.size; ++i) active[i] = random() % 3 == 0;
  for (int64_t i = 0; i < mass.size; ++i) mass[i] = normal(random);
  for (int64_t i = 0; i < factor.size; ++i) factor[i] = normal(random);
  std::vector<double> image(force.size), total(batch), scale(force.size, 1), bound(batch, 1);
  for (int64_t i = 0; i < force.size; ++i) {
    const int64_t m = i / size;
    force[i] = normal(random), weight[i] = 1 + std::abs(normal(random));
    if (!active[m * blocks + i % size / kChunk]) continue;
    v[i] = normal(random), free[i] = random() % 3 > 0;
    const double held = mass[m * nodes + i % size / each] * v[i], pushed = double(factor[m]) * force[i];
    const double of_a = free[i] ? held + pushed : double(v[i]);
    image[i] = of_a / weight[i], scale[i] += std::abs(held) + std::abs(pushed);
    total[m] += of_a * v[i], bound[m] += scale[i] * std::abs(v[i]);
  }
  std::unique_ptr<Array<T>> bits;
  for (const Pool* pool : pools) {
    const Array<T> to(force);
    product(*pool, batch, Product<T>{to.data.get(), v.data.get(), mass.data.get(), factor.data.get(), free.data.get(),
                                     weight.data.get(), active.data.get(), to.data.get(), sum.data.get(), size, nodes,
                                     true});
    const Shape shape = {1, 0, batch, size, 0, 0};
    compare("product", shape, to, image, scale);
    compare("product's sum", shape, sum, total, bound);
    if (bits == nullptr) bits = std::make_unique<Array<T>>(sum);
    expect_same("a product's sum", *bits, sum);
  }
}

// A = V diag(w) Vᵀ and F = R S of random matrices, of all magnitudes, with repeated eigenvalues, of zeros alone. V and R
// are rotations, and S is symmetric. What is not finite spoils its own particle alone.
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
  std::unique_ptr<Array<T>> bits_w, bits_V, bits_R;
  for (const Pool* pool : pools) {
    eigen(*pool, batch, Eigen<T>{matrices.data.get(), values.data.get(), vectors.data.get(), n});
    rotation(*pool, batch, Rotation<T>{matrices.data.get(), rotations.data.get(), n});
    if (bits_w == nullptr) {
      bits_w = std::make_unique<Array<T>>(values);
      bits_V = std::make_unique<Array<T>>(vectors);
      bits_R = std::make_unique<Array<T>>(rotations);
    }
    expect_same("eigenvalues", *bits_w, values);
    expect_same("eigenvectors", *bits_V, vectors);
    expect_same("rotations", *bits_R, rotations);
  }
  // Of what is found: V diag(w) Vᵀ, VᵀV, RᵀR, and RᵀF beside its transpose.
  const Array<T> product(matrices.size), squares(2 * matrices.size), stretch(matrices.size);
  std::vector<double> A(matrices.size), one(squares.size), transposed(A.size()), scale(A.size()), ones(one.size(), 1);
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
          product[at(i, j)] = T(a), A[at(i, j)] = matrices[i < j ? at(i, j) : at(j, i)];
          squares[at(i, j)] = T(v), squares[matrices.size + at(i, j)] = T(r);
          one[at(i, j)] = one[matrices.size + at(i, j)] = std::isfinite(size) ? i == j : size;
          stretch[at(i, j)] = T(s), transposed[at(i, j)] = t;
          if (!std::isfinite(size)) A[at(i, j)] = size, squares[at(i, j)] = T(size);  // V may be the identity
          scale[at(i, j)] = size;
        }
      }
    }
  }
  compare("V diag(w) Vt", shape, product, A, scale);
  compare("VtV, RtR", shape, squares, one, ones);
  compare("RtF", shape, stretch, transposed, scale);
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
        int32_t *first = expected.data.get() + m * count, *last = first + count;
        std::iota(first, last, 0);
        std::stable_sort(first, last, [&](int32_t a, int32_t b) { return keys[m * count + a] < keys[m * count + b]; });
      }
      for (const Pool* pool : pools) {
        const Array<int32_t> result(keys.size);
        order(*pool, batch, Order{keys.data.get(), result.data.get(), count});
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
        std::iota(order.data.get() + m * count, order.data.get() + (m + 1) * count, 0);
        std::shuffle(order.data.get() + m * count, order.data.get() + (m + 1) * count, random);
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
          T* target = in_place ? source.data.get() : to.data.get();
          rearrange(*pool, batch, Rearrangement<T>{wanted.data.get(), order.data.get(), source.data.get(), target, rows,
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
