// Checks the sums against sums written node by node, on random problems: all dimensions, orders, precisions and numbers
// of columns, batches, periodic axes, indices beyond the window and as large as integers are, offsets that are not
// finite, no particle and one. Any number of threads must give the same bits. Arrays end where they end, so that a
// sanitizer sees what reads or writes beyond; native/check compiles this with each of them.

#include "check.h"
#include "kernels.h"

using namespace mpmjax;

namespace {

// The arrays of all sums and of their differentials. Those of a resistance have d columns and matrices of their own.
template <class T>
struct Example {
  Shape shape;
  Basis<T> basis = {};
  Array<int32_t> first;
  Array<T> offset, change, nodes, values, matrices, moved;
  Array<T> to_nodes, gathered, by_offset, beside, resisted;  // results; `beside` the pull is the gather again

  Example(Shape sh, int oddity, std::mt19937& random)
      : shape(sh),
        first(sh.batch * sh.d * sh.particles),
        offset(first.size), change(first.size),
        nodes(sh.batch * sh.size() * sh.columns),
        values((sh.d + 1) * sh.batch * sh.columns * sh.particles),
        matrices(sh.batch * matrix_entries(sh.d) * sh.particles),
        moved(sh.batch * sh.size() * sh.d),
        to_nodes(nodes.size), gathered(values.size), by_offset(first.size), beside(values.size),
        resisted(moved.size) {
    std::uniform_real_distribution<T> half(T(-0.5), T(0.5));
    std::normal_distribution<T> normal;
    for (const Array<T>* array : {&change, &nodes, &values, &matrices, &moved}) array->draw(random);
    for (int64_t i = 0; i < offset.size; ++i) offset[i] = half(random);
    basis.d = sh.d, basis.s = sh.s, basis.terms = sh.s + 1;
    for (int i = 0; i < sh.s; ++i) {
      basis.knots[i] = half(random);
      for (int k = 0; k < basis.terms; ++k) {
        basis.weights[i][k] = normal(random) / 3, basis.slopes[i][k] = normal(random) / 3;
      }
    }
    const int32_t along = int32_t(sh.along), beyond = oddity > 0 ? 2 : 0;
    for (int a = sh.d - 1, stride = 1; a >= 0; --a, stride *= along) {
      basis.shape[a] = along, basis.strides[a] = stride, basis.periodic[a] = random() % 4 == 0;
    }
    std::uniform_int_distribution<int32_t> inside(-beyond, along - sh.s + beyond), around(-beyond, along - 1 + beyond);
    std::uniform_int_distribution<int32_t> any(std::numeric_limits<int32_t>::min());
    for (int64_t i = 0; i < first.size; ++i) {
      const int64_t p = i % sh.particles;
      const int a = int(i / sh.particles % sh.d);
      const int32_t place = basis.periodic[a] ? around(random) : inside(random);
      first[i] = oddity == -2 ? in_turn(p, a) : oddity == -1 ? 0 : oddity > 1 && p % 7 == 3 ? any(random) : place;
    }
    if (oddity > 1 || oddity == -2) {
      for (int64_t i = 5; i < nodes.size; i += 89) nodes[i] = std::numeric_limits<T>::infinity();
    }
    if (oddity > 1) {
      for (int64_t i = 0; i < offset.size; i += 97) offset[i] = std::numeric_limits<T>::quiet_NaN();
      for (int64_t i = 7; i < matrices.size; i += 997) matrices[i] = std::numeric_limits<T>::quiet_NaN();
    }
  }

  Stencils<T> stencils(bool differential) const {
    return {first.get(), offset.get(), differential ? change.get() : nullptr, shape.particles, basis};
  }
  // Places that particles take in turn, two at each, some of them beside the one before, along the last axis first.
  int32_t in_turn(int64_t p, int axis) const {
    const int64_t places = shape.along - shape.s + 1;
    int64_t place = std::max<int64_t>(p / 2 - (p % 5 == 4), 0);
    for (int a = shape.d - 1; a > axis; --a) place /= places;
    return int32_t(place % places);
  }
  int64_t rows() const { return shape.batch * shape.columns * shape.particles; }

  // The index term of the i-th node of a particle along an axis, as `first` says at this place.
  uint32_t term(int64_t at, int a, int i) const {
    const int64_t n = basis.shape[a], begin = first[at], from = (begin % n + n) % n;
    const int64_t node = basis.periodic[a] ? begin + (from + i) % n - from : begin + i;
    return uint32_t(node) * uint32_t(basis.strides[a]);
  }
  // The i-th weight or slope there, and its derivative.
  void polynomial(int64_t at, int i, bool slope, double* value) const {
    const T* c = slope ? basis.slopes[i] : basis.weights[i];
    const double x = double(offset[at]) - basis.knots[i];
    value[0] = value[1] = 0;
    for (int k = basis.terms - 1; k >= 0; --k) value[1] = value[1] * x + value[0], value[0] = value[0] * x + c[k];
  }
};

// Calls visit(m, p, node, basis, by_offset) for each member, particle and stencil node; `basis` has the weight and the
// gradient's components, or their differentials, and `by_offset` their derivatives along each axis.
template <class T, class Visit>
void each_node(const Example<T>& e, bool differential, const Visit& visit) {
  const Shape& sh = e.shape;
  const int64_t count = int64_t(std::pow(sh.s, sh.d) + 0.5);
  for (int64_t i = 0; i < sh.batch * sh.particles; ++i) {
    const int64_t m = i / sh.particles, p = i % sh.particles;
    const auto at = [&](int a) { return (m * sh.d + a) * sh.particles + p; };
    double table[3][4][2][2];
    for (int a = 0; a < sh.d; ++a) {
      for (int k = 0; k < sh.s; ++k) {
        for (const bool slope : {false, true}) e.polynomial(at(a), k, slope, table[a][k][slope]);
      }
    }
    for (int64_t k = 0; k < count; ++k) {
      uint32_t node = 0;
      int offsets[3];
      for (int64_t a = sh.d - 1, rest = k; a >= 0; --a, rest /= sh.s) {
        offsets[a] = int(rest % sh.s);
        node += e.term(at(int(a)), int(a), offsets[a]);
      }
      double basis[4], by_offset[3][4];
      for (int b = 0; b <= sh.d; ++b) {
        double value = 1, change = 0;
        for (int along = 0; along < sh.d; ++along) {
          double product = 1;
          for (int a = 0; a < sh.d; ++a) product *= table[a][offsets[a]][b == a + 1][a == along];
          by_offset[along][b] = product;
          change += product * e.change[at(along)];
          value *= table[along][offsets[along]][b == along + 1][0];
        }
        basis[b] = differential ? change : value;
      }
      visit(m, p, int32_t(node), basis, by_offset);
    }
  }
}

template <class T>
void check(const Example<T>& e, const std::vector<const Pool*>& pools) {
  const Shape& sh = e.shape;
  const int64_t rows = e.rows(), n = sh.size();
  // Of a scatter or pull: all given, value alone, gradients alone; differential; gradients with a column less.
  for (int kind = 0; kind < 5; ++kind) {
    const bool valued = kind != 2, differential = kind == 3;
    const int64_t graded = kind == 1 ? 0 : kind == 4 ? sh.columns - 1 : sh.columns;
    Scatter<T> scattered = {e.stencils(differential), {}, e.to_nodes.get(), nullptr, nullptr, n, sh.columns, nullptr};
    T *value = e.gathered.get(), *gradients = value + rows;
    const Gather<T> gathered = {e.stencils(differential), e.nodes.get(), value, gradients, n, sh.columns};
    Pull<T> pulled = {e.stencils(false), e.nodes.get(), {}, e.by_offset.get(), e.beside.get(),
                      e.beside.get() + rows, n, sh.columns};
    if (kind == 4) pulled.value = pulled.gradients = nullptr;
    if (valued) scattered.values.value = e.values.get();
    if (kind != 1) scattered.values.gradients = e.values.get() + rows;
    scattered.values.graded = graded;
    pulled.values = scattered.values;
    // Where a value, or one of a gradient's columns, is in such arrays.
    const auto place = [&](int b, int64_t columns, int64_t m, int64_t c, int64_t p) {
      const int64_t row = b == 0 ? m * sh.columns + c : (m * sh.d + b - 1) * columns + c;
      return (b == 0 ? 0 : rows) + row * sh.particles + p;
    };
    by_all(pools, "sums", [&](const Pool& pool) {
      scatter(pool, sh.batch, scattered);
      gather(pool, sh.batch, gathered);
      if (!differential) pull(pool, sh.batch, pulled);
    }, e.to_nodes, e.gathered, e.by_offset, e.beside);
    Expected to(e.to_nodes.size), from(e.gathered.size), by_offset(e.by_offset.size);
    each_node(e, differential, [&](int64_t m, int64_t p, int32_t node, const double* basis, const auto& slopes) {
      const bool inside = node >= 0 && node < n;
      const int64_t clipped = node < 0 ? 0 : node >= n ? n - 1 : node;
      for (int64_t c = 0; c < sh.columns; ++c) {
        const double f = e.nodes[(m * n + clipped) * sh.columns + c];
        const int64_t at = (m * n + node) * sh.columns + c;
        for (int b = 0; b <= sh.d; ++b) {
          from.add(place(b, sh.columns, m, c, p), basis[b] * f, 30 * std::abs(basis[b] * f) + 30 * std::abs(f));
          if (b == 0 ? !valued : kind == 1) continue;
          const double a = b > 0 && c >= graded ? 0 : e.values[place(b, graded, m, c, p)];
          if (inside) to.add(at, basis[b] * a, 30 * std::abs(basis[b] * a) + 30 * std::abs(a));
          for (int axis = 0; axis < sh.d && !differential; ++axis) {
            const double term = f * a * slopes[axis][b];
            by_offset.add((m * sh.d + axis) * sh.particles + p, term, 30 * std::abs(term) + 30 * std::abs(f * a));
          }
        }
      }
    });
    compare("scatter", sh, e.to_nodes, to);
    compare("gather", sh, e.gathered, from);
    if (!differential && kind != 4) compare("gather beside a pull", sh, e.beside, from);
    if (!differential) compare("pull", sh, e.by_offset, by_offset);
  }
}

// An average, against the scatter of the same: the divided columns to rounding, in memory of any content.
template <class T>
void check_average(const Example<T>& e, const std::vector<const Pool*>& pools) {
  const Shape& sh = e.shape;
  const int64_t rows = e.rows(), n = sh.size(), others = sh.columns - 1;
  const ParticleValues<T> values = {e.values.get(), e.values.get() + rows, others};
  const Scatter<T> scattered = {e.stencils(false), values, e.to_nodes.get(), nullptr, nullptr, n, sh.columns, nullptr};
  const Array<T> least(sh.batch), whole(sh.batch * n), means(sh.batch * n * others), work(e.to_nodes.size);
  least.fill(T(0.1));
  const Average<T> task = {e.stencils(false), values, least.get(), whole.get(), means.get(),
                           work.get(), nullptr, nullptr, n, sh.columns};
  scatter(*pools[0], sh.batch, scattered);
  const Array<T> expected_whole(whole.size), expected_means(means.size);
  for (int64_t i = 0; i < whole.size; ++i) {
    const T* sums = &e.to_nodes[i * sh.columns];
    const bool some = sums[others] > T(0.1);
    expected_whole[i] = some ? sums[others] : 0;
    for (int64_t k = 0; k < others; ++k) expected_means[i * others + k] = some ? sums[k] / sums[others] : 0;
  }
  for (const Pool* pool : pools) {
    whole.fill(7), means.fill(7), work.fill(7);
    average(*pool, sh.batch, task);
    expect_same("the whole of an average", expected_whole, whole);
    expect_same("the means of an average", expected_means, means);
  }
}

// P2G against an average of what it makes of its arrays, G2P against a gather, in place and apart.
template <class T>
void check_moves(const Example<T>& e, std::mt19937& random, const std::vector<const Pool*>& pools) {
  const Shape& sh = e.shape;
  const int d = sh.d, m = d * d;
  const int64_t p = sh.particles, n = sh.size();
  const Array<T> slope(sh.batch), factor(sh.batch), least(sh.batch), mass(sh.batch * p), x(sh.batch * d * p);
  const Array<T> q(mass), even(mass), A(sh.batch * m * p), B(A), C(A), values(sh.batch * (d + 1) * p), gradients(A);
  for (const Array<T>* array : {&slope, &factor, &mass, &q, &even, &x, &A, &B, &C}) array->draw(random);
  for (const Array<T>* array : {&mass, &slope, &least}) {
    for (int64_t i = 0; i < array->size; ++i) (*array)[i] = 1 + std::abs((*array)[i]);
  }
  const Array<T> whole(sh.batch * n), means(sh.batch * n * d), sums(sh.batch * n * (d + 1));
  for (int kind = 0; kind < 6; ++kind) {  // both terms, C alone, A Bᵀ alone, A alone, q B Bᵀ + r I alone, r I alone
    const bool affine = kind < 2, pushed = kind != 1, isotropic = kind > 3, factored = pushed && kind % 2 == 0;
    for (int64_t i = 0; i < sh.batch * p; ++i) {
      const int64_t b = i / p, k = i % p;
      const auto at = [&](const Array<T>& a, int64_t rows, int64_t row) -> T& { return a[(b * rows + row) * p + k]; };
      for (int r = 0; r < d; ++r) at(values, d + 1, r) = mass[i] * at(x, d, r);
      at(values, d + 1, d) = mass[i];
      for (int c = 0; c < d; ++c) {
        const double t = e.offset[(b * d + c) * p + k];
        const double moment = sh.s == 2 ? 0.25 - t * t : sh.s == 3 ? 1 / 4.0 : 1 / 3.0;
        for (int r = 0; r < d; ++r) {
          double product = isotropic ? r == c ? double(even[i]) : 0 : factored ? 0 : at(A, m, d * r + c);
          for (int l = 0; l < d && factored; ++l) {
            product += (isotropic ? double(q[i]) * at(B, m, d * r + l) : at(A, m, d * r + l)) * at(B, m, d * c + l);
          }
          const double turned = double(mass[i]) * at(C, m, d * r + c) * moment / slope[b];
          at(gradients, m, d * c + r) = T((pushed ? product * factor[b] * slope[b] : 0) + (affine ? turned : 0));
        }
      }
    }
    Average<T> made = {e.stencils(false), {values.get(), gradients.get(), d}, least.get(), whole.get(), means.get(),
                       sums.get(), nullptr, nullptr, n, d + 1};
    average(*pools[0], sh.batch, made);
    Expected expected(means.size, 1e-30);
    for (int64_t i = 0; i < means.size; ++i) {
      expected.add(i, means[i], 100 * (1 + std::abs(means[i])));
    }
    const P2G<T> task = {e.stencils(false), least.get(), slope.get(), factor.get(), mass.get(), x.get(),
                         affine ? C.get() : nullptr, pushed && !isotropic ? A.get() : nullptr,
                         factored ? B.get() : nullptr, kind == 4 ? q.get() : nullptr, isotropic ? even.get() : nullptr,
                         whole.get(), means.get(), sums.get(), nullptr, nullptr, n, d + 1};
    by_all(pools, "a P2G", [&](const Pool& pool) { p2g(pool, sh.batch, task); }, whole, means);
    compare("P2G", sh, means, expected);
  }
  const Array<T> value(x.size), gradient(A.size);
  const Gather<T> gathered = {e.stencils(false), e.moved.get(), value.get(), gradient.get(), n, d};
  gather(*pools[0], sh.batch, gathered);
  Expected moved(x.size), strained(A.size);
  for (int64_t i = 0; i < x.size; ++i) {
    const double change = double(factor[i / (d * p)]) * value[i];
    moved.add(i, x[i] + change, std::abs(double(x[i])) + std::abs(change));
  }
  for (int64_t i = 0; i < A.size; ++i) {
    const int64_t b = i / (m * p), row = i / p % m, k = i % p;
    const auto at = [&](const Array<T>& a, int64_t row) { return double(a[(b * m + row) * p + k]); };
    double change = 0, scale = std::abs(double(A[i]));
    for (int l = 0; l < d; ++l) {
      const double term = double(factor[b]) * slope[b] * at(gradient, d * l + row / d) * at(A, d * l + row % d);
      change += term, scale += std::abs(term);
    }
    strained.add(i, A[i] + change, scale);
  }
  by_all(pools, "a G2P", [&](const Pool& pool) {
    const Array<T> place(x), F(A);  // in place
    const G2P<T> task = {e.stencils(false), e.moved.get(), slope.get(), factor.get(), place.get(), F.get(), value.get(),
                         gradient.get(), place.get(), F.get(), n, d};
    g2p(pool, sh.batch, task);
    compare("x by G2P", sh, place, moved), compare("F by G2P", sh, F, strained);
  }, value, gradient);
}

// A resistance, against the gather, the product and the scatter one after the other.
template <class T>
void check_resistance(const Example<T>& e, const std::vector<const Pool*>& pools) {
  const Shape& sh = e.shape;
  const int d = sh.d, m = d * d;
  const int64_t n = sh.size(), particles = sh.particles, packed = mpmjax::matrix_entries(d);
  const Resist<T> task = {e.stencils(false), e.matrices.get(), e.moved.get(), e.resisted.get(), {},
                          nullptr, n, d, nullptr};
  by_all(pools, "a resistance", [&](const Pool& pool) {
    resist(pool, sh.batch, task, divided(pool, sh.batch, task));
  }, e.resisted);
  // The same where only some blocks of nodes are wanted, over other numbers.
  const int64_t size = n * d, blocks = blocks_of(size);
  const Array<bool> wanted(sh.batch * blocks);
  for (int64_t i = 0; i < wanted.size; ++i) wanted[i] = i % 3 > 0;
  for (const Pool* pool : pools) {
    const Array<T> some(e.resisted.size);
    some.fill(7);
    Resist<T> part = task;
    part.nodes = some.get(), part.wanted = wanted.get();
    resist(*pool, sh.batch, part, divided(*pool, sh.batch, part));
    for (int64_t i = 0; i < some.size; ++i) {
      if (!wanted[i / size * blocks + i % size / kChunk]) some[i] = e.resisted[i];
    }
    expect_same("the wanted part of a resistance", e.resisted, some);
  }
  // Of each particle the slopes G, m numbers, and r = K G; and what bounds their rounding.
  Expected G(sh.batch * particles * m), r(sh.batch * particles * m), expected(e.resisted.size);
  each_node(e, false, [&](int64_t b, int64_t p, int32_t node, const double* basis, const auto&) {
    const int64_t clipped = node < 0 ? 0 : node >= n ? n - 1 : node;
    for (int i = 0; i < m; ++i) {
      const double u = e.moved[(b * n + clipped) * d + i % d];
      G.add((b * particles + p) * m + i, basis[1 + i / d] * u, std::abs(basis[1 + i / d] * u) + std::abs(u));
    }
  });
  for (int64_t q = 0; q < sh.batch * particles; ++q) {
    for (int i = 0, k = 0; i < m; ++i) {
      for (int j = i; j < m; ++j, ++k) {
        const double entry = e.matrices[(q / particles * packed + k) * particles + q % particles];
        const int64_t at = q * m;
        r.add(at + i, entry * G.value[at + j], std::abs(entry) * G.scale[at + j]);
        if (j > i) r.add(at + j, entry * G.value[at + i], std::abs(entry) * G.scale[at + i]);
      }
    }
  }
  each_node(e, false, [&](int64_t b, int64_t p, int32_t node, const double* basis, const auto&) {
    if (node < 0 || node >= n) return;
    for (int i = 0; i < m; ++i) {
      const int64_t at = (b * particles + p) * m + i;
      const double w = basis[1 + i / d];
      expected.add((b * n + node) * d + i % d, w * r.value[at], 30 * (std::abs(w) + 1) * r.scale[at]);
    }
  });
  compare("resist", sh, e.resisted, expected);
}

// Solves of a batch: ‖r‖ is within its tolerance or the steps are used up, a member that may take no step is left as it
// was, and one that is not finite spoils no other. `e` has no indices beyond the window.
template <class T>
void check_solve(const Example<T>& e, std::mt19937& random, const std::vector<const Pool*>& pools) {
  const Shape& sh = e.shape;
  const int64_t n = sh.size(), size = n * sh.d, blocks = blocks_of(size), packed = e.matrices.size;
  const Array<T> matrices(packed), mass(sh.batch * n), factor(sh.batch), weight(sh.batch * size), start(weight.size);
  const Array<T> rhs(weight.size), limits(sh.batch * kTolerances), numbers(sh.batch * kOutcome);
  const Array<bool> free(weight.size), active(sh.batch * blocks);
  std::uniform_real_distribution<T> some(1, 2);
  for (int64_t i = 0; i < packed; ++i) matrices[i] = e.matrices[i] / 10;
  for (int64_t i = 0; i < mass.size; ++i) mass[i] = some(random);
  for (int64_t i = 0; i < active.size; ++i) active[i] = random() % 4 > 0;
  for (int64_t i = 0; i < weight.size; ++i) {
    const bool zero = !active[i / size * blocks + i % size / kChunk];
    free[i] = !zero && random() % 3 > 0, weight[i] = some(random), start[i] = zero ? 0 : some(random);
    rhs[i] = free[i] ? some(random) : 0;
  }
  for (int64_t m = 0; m < sh.batch; ++m) {
    T* of = &limits[m * kTolerances];
    factor[m] = T(0.1) * (m + 1), of[0] = T(1e-2), of[1] = T(m == 0 ? 0 : 40), of[2] = T(1e-10);
  }
  const int64_t last = sh.batch - 1;
  factor[last] = std::numeric_limits<T>::quiet_NaN();
  const Array<T> x(weight.size), memory(kVectors * weight.size);
  by_all(pools, "a solve", [&](const Pool& pool) {
    memory.fill(std::numeric_limits<T>::quiet_NaN());
    const Solve<T> task = {e.stencils(false), matrices.get(), mass.get(), factor.get(), free.get(),
                           weight.get(), active.get(), start.get(), rhs.get(), limits.get(),
                           x.get(), numbers.get(), memory.get(), n, sh.d, &pool == pools[0] ? 0 : kVectors * size};
    solve(pool, sh.batch, task);
    bool fine = numbers[1] == 0;
    for (int64_t i = 0; i < size; ++i) fine = fine && x[i] == start[i];
    for (int64_t m = 0; m < last; ++m) {
      const T* result = &numbers[m * kOutcome];
      fine = fine && (result[1] >= limits[m * kTolerances + 1] || std::sqrt(result[0]) <= T(1e-2) * result[7]);
      for (int64_t i = 0; i < size; ++i) fine = fine && std::isfinite(x[m * size + i]);
    }
    if (!fine) ++faults, std::printf("a solve of d=%d s=%d is off\n", sh.d, sh.s);
    std::fill(x.get() + last * size, x.get() + x.size, 0);
  }, x);
}

template <class T>
int check_all(const std::vector<const Pool*>& pools) {
  std::mt19937 random(1);
  int examples = 0;
  const auto check_one = [&](const Example<T>& e) {
    check(e, pools);
    if (e.shape.columns > 1) check_average(e, pools);
    check_resistance(e, pools);
    if (e.shape.columns == e.shape.d) check_moves(e, random, pools);
    ++examples;
  };
  const auto check_both = [&](const Shape& shape, int oddity) { check_one(Example<T>(shape, oddity, random)); };
  for (int d = 1; d <= 3; ++d) {
    for (int s = 2; s <= 4; ++s) {
      for (const int64_t particles : {0, 1, 16, 53}) {
        for (const int64_t columns : {1, 2, 3, 4, 6}) {
          const int oddity = int(random() % 5) - 2;  // in turn, all in one cell, inside, at the edge, anywhere
          check_both({d, s, 1 + int64_t(random() % 2), particles, 5, columns}, oddity);
        }
      }
    }
  }
  // Enough for several threads.
  for (int oddity = -2; oddity < 3; ++oddity) check_both({2, 3, 1, 20011, 40, 3}, oddity);
  for (int d = 1; d <= 3; ++d) {
    for (int s = 2; s <= 4; ++s) {
      for (int64_t columns = 1; columns <= 4; ++columns) check_both({d, s, 1, 1003, 20, columns}, -2);
    }
  }
  check_both({1, 2, 3, 30011, 999, 1}, 1);
  // Particles in the order of their cells, so that ranges of nodes share few of them: the first axis goes up evenly.
  const Example<T> ordered({2, 3, 2, 20011, 40, 2}, 0, random);
  for (int32_t p = 0; p < 20011; ++p) ordered.first[p] = p * 38 / 20011;
  check_one(ordered);
  // More nodes than a cache holds: those that no particle reaches are marked, and set to zero apart.
  for (int oddity = -2; oddity < 3; ++oddity) {
    const Example<T> wide({3, 3, 1, 2503, 100, 3}, oddity, random);
    check(wide, pools), check_average(wide, pools), ++examples;
  }
  for (int d = 1; d <= 3; ++d) {
    const Example<T> e({d, 3, 3, 53, 6, 1}, 0, random);
    check_solve(e, random, pools), ++examples;
  }
  const Example<T> large({2, 3, 3, 20011, 40, 1}, 0, random);
  check_solve(large, random, pools), ++examples;
  return examples;
}

}  // namespace

int main() {
  const Threads one(1), two(2), five(5);
  const std::vector<const Pool*> pools = {&one, &two, &five};
  int examples = check_all<float>(pools) + check_all<double>(pools) + check_arrays(pools);
  // Several callers at a time, as XLA's, on one pool.
  std::vector<std::thread> callers;
  for (int i = 0; i < 3; ++i) {
    callers.emplace_back([&, i] {
      std::mt19937 random(i);
      const Example<float> e({2, 3, 1, 9001 + i, 30, 3}, 1, random);
      Scatter<float> task = {e.stencils(false), {}, e.to_nodes.get(), nullptr, nullptr, e.shape.size(), 3, nullptr};
      task.values = {e.values.get(), e.values.get() + e.rows(), 3};
      scatter(one, 1, task);
      const Array<float> alone(e.to_nodes);
      for (int k = 0; k < 5; ++k) {
        scatter(five, 1, task);
        expect_same("a scatter among others", alone, e.to_nodes);
      }
    });
  }
  for (std::thread& caller : callers) caller.join();
  std::printf("%d examples, %s: %d faults\n", examples, instructions(), faults);
  return faults == 0 ? 0 : 1;
}
