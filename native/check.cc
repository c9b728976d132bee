// Checks the sums against sums written node by node, on random problems: all dimensions, orders, precisions and
// numbers of columns, batches, indices beyond the window and as large as integers are, factors that are not finite, no
// particle and one. Any number of threads must give the same bits. Arrays end where they end, so that a sanitizer sees
// what reads or writes beyond; native/check compiles this with each of them.

#include <random>
#include <string>

#include "check.h"
#include "solve.h"
#include "sums.h"
#include "targets.h"
#include "vectors.h"

using namespace mpmjax;

namespace {

// The arrays of all sums and of their differentials. Those of a resistance have d columns and matrices of their own.
template <class T>
struct Example {
  Shape shape;
  Array<int32_t> index;
  Array<T> w, g, dw, dg, nodes, given;
  Array<T> matrices, moved;
  Array<T> to_nodes, gathered, by_w, by_g, beside, resisted;  // results; `beside` the pull is the gather again

  Example(Shape sh, int oddity, std::mt19937& random)
      : shape(sh),
        index(sh.batch * sh.d * sh.s * sh.particles),
        w(index.size), g(index.size), dw(index.size), dg(index.size),
        nodes(sh.batch * sh.size() * sh.columns),
        given((sh.d + 1) * sh.batch * sh.columns * sh.particles),
        matrices(sh.batch * sh.d * sh.d * (sh.d * sh.d + 1) / 2 * sh.particles),
        moved(sh.batch * sh.size() * sh.d),
        to_nodes(nodes.size), gathered(given.size), by_w(index.size), by_g(index.size), beside(given.size),
        resisted(moved.size) {
    std::normal_distribution<T> normal;
    for (const Array<T>* array : {&w, &g, &dw, &dg, &nodes, &given, &matrices, &moved}) {
      for (int64_t i = 0; i < array->size; ++i) (*array)[i] = normal(random);
    }
    const int64_t beyond = oddity > 0 ? 2 : 0;
    std::uniform_int_distribution<int64_t> first(-beyond, sh.along - sh.s + beyond);
    std::uniform_int_distribution<int32_t> any(std::numeric_limits<int32_t>::min());
    for (int64_t m = 0; m < sh.batch; ++m) {
      for (int64_t p = 0; p < sh.particles; ++p) {
        const bool wild = oddity > 1 && p % 7 == 3;
        int64_t stride = 1;
        for (int a = sh.d - 1; a >= 0; --a, stride *= sh.along) {
          const int64_t base = oddity == -2 ? in_turn(p, a) : oddity == -1 ? 0 : first(random);
          for (int i = 0; i < sh.s; ++i) {
            const int64_t at = ((m * sh.d + a) * sh.s + i) * sh.particles + p;
            index[at] = wild ? any(random) : int32_t((base + i) * stride);
          }
        }
      }
    }
    if (oddity > 1 || oddity == -2) {
      for (int64_t i = 5; i < nodes.size; i += 89) nodes[i] = std::numeric_limits<T>::infinity();
    }
    if (oddity > 1) {
      for (int64_t i = 0; i < w.size; i += 97) w[i] = g[i] = dw[i] = dg[i] = std::numeric_limits<T>::quiet_NaN();
      for (int64_t i = 7; i < matrices.size; i += 997) matrices[i] = std::numeric_limits<T>::quiet_NaN();
    }
  }

  Stencils<T> stencils(bool differential) const {
    return {index.data.get(), w.data.get(), g.data.get(), differential ? dw.data.get() : nullptr,
            differential ? dg.data.get() : nullptr, shape.particles, {}};
  }
  // Places that particles take in turn, two at each, some of them beside the one before, along the last axis first.
  int64_t in_turn(int64_t p, int axis) const {
    const int64_t places = shape.along - shape.s + 1;
    int64_t place = std::max<int64_t>(p / 2 - (p % 5 == 4), 0);
    for (int a = shape.d - 1; a > axis; --a) place /= places;
    return place % places;
  }
  int64_t rows() const { return shape.batch * shape.columns * shape.particles; }
};

// Calls visit(m, p, node, basis, offsets) for each member, particle and stencil node; `basis` has the weight and the
// gradient's components, or their differentials.
template <class T, class Visit>
void each_node(const Example<T>& e, bool differential, const Visit& visit) {
  const Shape& sh = e.shape;
  const int64_t count = int64_t(std::pow(sh.s, sh.d) + 0.5);
  for (int64_t m = 0; m < sh.batch; ++m) {
    for (int64_t p = 0; p < sh.particles; ++p) {
      for (int64_t k = 0; k < count; ++k) {
        uint32_t node = 0;
        int offsets[3];
        for (int64_t a = sh.d - 1, rest = k; a >= 0; --a, rest /= sh.s) {
          offsets[a] = int(rest % sh.s);
          node += uint32_t(e.index[((m * sh.d + a) * sh.s + offsets[a]) * sh.particles + p]);
        }
        double basis[4];
        for (int b = 0; b <= sh.d; ++b) {
          double value = 1, change = 0;
          for (int a = 0; a < sh.d; ++a) {
            const int64_t at = ((m * sh.d + a) * sh.s + offsets[a]) * sh.particles + p;
            const double factor = b == a + 1 ? e.g[at] : e.w[at], its = b == a + 1 ? e.dg[at] : e.dw[at];
            change = change * factor + value * its;
            value *= factor;
          }
          basis[b] = differential ? change : value;
        }
        visit(m, p, int32_t(node), basis, offsets);
      }
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
    const Form form{sh.d, sh.s, differential};
    Scatter<T> scattered = {e.stencils(differential), {}, e.to_nodes.data.get(), nullptr, nullptr, n, sh.columns, nullptr};
    T *value = e.gathered.data.get(), *gradients = value + rows;
    const Gather<T> gathered = {e.stencils(differential), e.nodes.data.get(), value, gradients, n, sh.columns};
    Pull<T> pulled = {e.stencils(false), e.nodes.data.get(), {}, e.by_w.data.get(), e.by_g.data.get(),
                      e.beside.data.get(), e.beside.data.get() + rows, n, sh.columns};
    if (kind == 4) pulled.value = pulled.gradients = nullptr;
    if (valued) scattered.given.value = e.given.data.get();
    if (kind != 1) scattered.given.gradients = e.given.data.get() + rows;
    scattered.given.graded = graded;
    pulled.given = scattered.given;
    // Where a value, or one of a gradient's columns, is in such arrays.
    const auto place = [&](int b, int64_t columns, int64_t m, int64_t c, int64_t p) {
      const int64_t row = b == 0 ? m * sh.columns + c : (m * sh.d + b - 1) * columns + c;
      return (b == 0 ? 0 : rows) + row * sh.particles + p;
    };
    std::unique_ptr<Array<T>> bits[5];
    for (const Pool* pool : pools) {
      const bool known = scatter(*pool, form, sh.batch, scattered) && gather(*pool, form, sh.batch, gathered) &&
                         (differential || pull(*pool, form, sh.batch, pulled));
      if (!known) ++faults, std::printf("no kernel for d=%d s=%d\n", sh.d, sh.s);
      int k = 0;
      for (const Array<T>* result : {&e.to_nodes, &e.gathered, &e.by_w, &e.by_g, &e.beside}) {
        if (bits[k] == nullptr) {
          bits[k] = std::make_unique<Array<T>>(*result);
        } else {
          expect_same("sums", *bits[k], *result);
        }
        ++k;
      }
    }
    std::vector<double> to(e.to_nodes.size), to_scale(e.to_nodes.size), from(e.gathered.size), from_scale(from.size());
    std::vector<double> by_w(e.by_w.size), by_g(e.by_g.size), by_scale(e.by_w.size), by_g_scale(e.by_g.size);
    each_node(e, differential, [&](int64_t m, int64_t p, int32_t node, const double* basis, const int* offsets) {
      const bool inside = node >= 0 && node < n;
      const int64_t clipped = node < 0 ? 0 : node >= n ? n - 1 : node;
      for (int64_t c = 0; c < sh.columns; ++c) {
        const double f = e.nodes[(m * n + clipped) * sh.columns + c];
        const int64_t at = (m * n + node) * sh.columns + c;
        for (int b = 0; b <= sh.d; ++b) {
          from[place(b, sh.columns, m, c, p)] += basis[b] * f;
          from_scale[place(b, sh.columns, m, c, p)] += 30 * std::abs(basis[b] * f) + 30 * std::abs(f);
          if (b == 0 ? !valued : kind == 1) continue;
          const double a = b > 0 && c >= graded ? 0 : e.given[place(b, graded, m, c, p)];
          if (inside) to[at] += basis[b] * a;
          if (inside) to_scale[at] += 30 * std::abs(basis[b] * a) + 30 * std::abs(a);
          for (int axis = 0; axis < sh.d && !differential; ++axis) {
            double rest = f * a;
            for (int other = 0; other < sh.d; ++other) {
              const int64_t o = ((m * sh.d + other) * sh.s + offsets[other]) * sh.particles + p;
              if (other != axis) rest *= b == other + 1 ? e.g[o] : e.w[o];
            }
            const int64_t own = ((m * sh.d + axis) * sh.s + offsets[axis]) * sh.particles + p;
            (b == axis + 1 ? by_g : by_w)[own] += rest;
            (b == axis + 1 ? by_g_scale : by_scale)[own] += 30 * std::abs(rest) + 30 * std::abs(f * a);
          }
        }
      }
    });
    compare("scatter", sh, e.to_nodes, to, to_scale);
    compare("gather", sh, e.gathered, from, from_scale);
    if (!differential && kind != 4) compare("gather beside a pull", sh, e.beside, from, from_scale);
    if (!differential) compare("pull by weights", sh, e.by_w, by_w, by_scale);
    if (!differential) compare("pull by derivatives", sh, e.by_g, by_g, by_g_scale);
  }
}

// Sums that are given places, against those of the factors that these places have.
template <class T>
void check_places(const Shape& sh, int oddity, std::mt19937& random, const std::vector<const Pool*>& pools) {
  const Example<T> e(sh, oddity, random);
  const int64_t rows = e.rows(), n = sh.size(), places = sh.batch * sh.d * sh.particles, numbers = sh.s + 2;
  const Array<int32_t> first(places), strides(sh.batch * sh.d);
  const Array<T> offset(places), polynomials(sh.batch * 2 * sh.s * numbers), least(sh.batch), whole(sh.batch * n);
  const Array<T> means(sh.batch * n * (sh.columns - 1)), work(e.to_nodes.size);
  std::normal_distribution<T> normal;
  for (const Array<T>* array : {&offset, &polynomials}) {
    for (int64_t i = 0; i < array->size; ++i) (*array)[i] = normal(random);
  }
  for (int64_t m = 0; m < sh.batch; ++m) {
    int32_t stride = 1;
    for (int a = sh.d - 1; a >= 0; --a, stride *= int32_t(sh.along)) strides[m * sh.d + a] = stride;
    for (int a = 0; a < sh.d; ++a) {
      for (int64_t p = 0; p < sh.particles; ++p) {
        const int64_t axis = m * sh.d + a, at = axis * sh.particles + p;
        first[at] = e.index[axis * sh.s * sh.particles + p] / strides[axis];
        for (int i = 0; i < sh.s; ++i) {
          for (int part = 0; part < 2; ++part) {
            const T* c = &polynomials[((m * 2 + part) * sh.s + i) * numbers];
            T sum = c[sh.s + 1];
            for (int k = sh.s; k > 0; --k) sum = sum * (offset[at] - c[0]) + c[k];
            (part == 0 ? e.w : e.g)[(axis * sh.s + i) * sh.particles + p] = sum;
          }
        }
      }
    }
    least[m] = std::numeric_limits<T>::min();
  }
  Stencils<T> placed = {};
  placed.particles = sh.particles;
  placed.places = {first.data.get(), strides.data.get(), offset.data.get(), polynomials.data.get()};
  const Form form{sh.d, sh.s, false};
  const Given<T> given = {e.given.data.get(), e.given.data.get() + rows, sh.columns - 1};
  const auto sum = [&](const Pool& pool, const Stencils<T>& stencils) {
    T *value = e.gathered.data.get(), *gradients = value + rows;
    gather(pool, form, sh.batch, Gather<T>{stencils, e.nodes.data.get(), value, gradients, n, sh.columns});
    scatter(pool, form, sh.batch, Scatter<T>{stencils, given, e.to_nodes.data.get(), nullptr, nullptr, n, sh.columns, nullptr});
    resist(pool, form, sh.batch, Resist<T>{stencils, e.matrices.data.get(), e.moved.data.get(), e.resisted.data.get(), {},
                                           nullptr, n, sh.d, nullptr});
    average(pool, form, sh.batch, Average<T>{stencils, given, least.data.get(), whole.data.get(), means.data.get(),
                                             work.data.get(), nullptr, nullptr, n, sh.columns});
  };
  const auto as_expected = [](const Array<T>& found) {
    std::vector<double> numbers(found.size);
    for (int64_t i = 0; i < found.size; ++i) numbers[i] = found[i];
    return numbers;
  };
  const auto rounding = [](const std::vector<double>& numbers) {
    double most = 0;
    for (const double number : numbers) most = std::max(most, std::isfinite(number) ? std::abs(number) : 0);
    return std::vector<double>(numbers.size(), 100 * most);
  };
  sum(*pools[0], e.stencils(false));
  const auto to = as_expected(e.to_nodes), from = as_expected(e.gathered), weights = as_expected(whole);
  const auto resisted = as_expected(e.resisted);
  std::unique_ptr<Array<T>> bits[4];
  for (const Pool* pool : pools) {
    sum(*pool, placed);
    compare("scatter by places", sh, e.to_nodes, to, rounding(to));
    compare("gather by places", sh, e.gathered, from, rounding(from));
    compare("whole weights by places", sh, whole, weights, rounding(to));
    compare("a resistance by places", sh, e.resisted, resisted, rounding(resisted));
    int k = 0;
    for (const Array<T>* result : {&e.to_nodes, &e.gathered, &means, &e.resisted}) {
      if (bits[k] == nullptr) bits[k] = std::make_unique<Array<T>>(*result);
      expect_same("sums by places", *bits[k++], *result);
    }
  }
}

// An average, against the scatter of the same: the divided columns to rounding, in memory of any content.
template <class T>
void check_average(const Example<T>& e, const std::vector<const Pool*>& pools) {
  const Shape& sh = e.shape;
  const int64_t rows = e.rows(), n = sh.size(), others = sh.columns - 1;
  const Given<T> given = {e.given.data.get(), e.given.data.get() + rows, others};
  const Scatter<T> scattered = {e.stencils(false), given, e.to_nodes.data.get(), nullptr, nullptr, n, sh.columns, nullptr};
  const Array<T> least(sh.batch), whole(sh.batch * n), means(sh.batch * n * others), work(e.to_nodes.size);
  for (int64_t i = 0; i < least.size; ++i) least[i] = T(0.1);
  const Average<T> task = {e.stencils(false), given, least.data.get(), whole.data.get(), means.data.get(),
                           work.data.get(), nullptr, nullptr, n, sh.columns};
  scatter(*pools[0], {sh.d, sh.s, false}, sh.batch, scattered);
  const Array<T> expected_whole(whole.size), expected_means(means.size);
  for (int64_t i = 0; i < whole.size; ++i) {
    const T* sums = &e.to_nodes[i * sh.columns];
    const bool some = sums[others] > T(0.1);
    expected_whole[i] = some ? sums[others] : 0;
    for (int64_t k = 0; k < others; ++k) expected_means[i * others + k] = some ? sums[k] / sums[others] : 0;
  }
  for (const Pool* pool : pools) {
    for (const Array<T>* array : {&whole, &means, &work}) {
      for (int64_t i = 0; i < array->size; ++i) (*array)[i] = 7;
    }
    if (!average(*pool, {sh.d, sh.s, false}, sh.batch, task)) ++faults, std::printf("no kernel for an average\n");
    expect_same("the whole of an average", expected_whole, whole);
    expect_same("the means of an average", expected_means, means);
  }
}

// A resistance, against the gather, the product and the scatter one after the other.
template <class T>
void check_resistance(const Example<T>& e, const std::vector<const Pool*>& pools) {
  const Shape& sh = e.shape;
  const int d = sh.d, m = d * d;
  const int64_t n = sh.size(), particles = sh.particles, packed = m * (m + 1) / 2;
  const Resist<T> task = {e.stencils(false), e.matrices.data.get(), e.moved.data.get(), e.resisted.data.get(), {},
                          nullptr, n, d, nullptr};
  std::unique_ptr<Array<T>> bits;
  for (const Pool* pool : pools) {
    if (!resist(*pool, {d, sh.s, false}, sh.batch, task)) ++faults, std::printf("no kernel for d=%d s=%d\n", d, sh.s);
    if (bits == nullptr) bits = std::make_unique<Array<T>>(e.resisted);
    expect_same("a resistance", *bits, e.resisted);
  }
  // The same where only some blocks of nodes are wanted, over other numbers.
  const int64_t size = n * d, blocks = (size + kTogether - 1) / kTogether;
  const Array<bool> wanted(sh.batch * blocks);
  for (int64_t i = 0; i < wanted.size; ++i) wanted[i] = i % 3 > 0;
  for (const Pool* pool : pools) {
    const Array<T> some(e.resisted.size);
    for (int64_t i = 0; i < some.size; ++i) some[i] = 7;
    Resist<T> part = task;
    part.nodes = some.data.get(), part.wanted = wanted.data.get();
    resist(*pool, {d, sh.s, false}, sh.batch, part);
    for (int64_t i = 0; i < some.size; ++i) {
      if (!wanted[i / size * blocks + i % size / kTogether]) some[i] = e.resisted[i];
    }
    expect_same("the wanted part of a resistance", *bits, some);
  }
  // Of each particle the slopes G, m numbers, and r = K G; and what bounds their rounding.
  std::vector<double> G(sh.batch * particles * m), G_scale(G.size()), r(G.size()), r_scale(G.size());
  each_node(e, false, [&](int64_t b, int64_t p, int32_t node, const double* basis, const int*) {
    const int64_t clipped = node < 0 ? 0 : node >= n ? n - 1 : node;
    for (int i = 0; i < m; ++i) {
      const double u = e.moved[(b * n + clipped) * d + i % d];
      G[(b * particles + p) * m + i] += basis[1 + i / d] * u;
      G_scale[(b * particles + p) * m + i] += std::abs(basis[1 + i / d] * u) + std::abs(u);
    }
  });
  for (int64_t b = 0; b < sh.batch; ++b) {
    for (int64_t p = 0; p < particles; ++p) {
      for (int i = 0, k = 0; i < m; ++i) {
        for (int j = i; j < m; ++j, ++k) {
          const double entry = e.matrices[(b * packed + k) * particles + p];
          const int64_t at = (b * particles + p) * m;
          r[at + i] += entry * G[at + j];
          r_scale[at + i] += std::abs(entry) * G_scale[at + j];
          if (j > i) r[at + j] += entry * G[at + i];
          if (j > i) r_scale[at + j] += std::abs(entry) * G_scale[at + i];
        }
      }
    }
  }
  std::vector<double> expected(e.resisted.size), scale(e.resisted.size);
  each_node(e, false, [&](int64_t b, int64_t p, int32_t node, const double* basis, const int*) {
    if (node < 0 || node >= n) return;
    for (int i = 0; i < m; ++i) {
      expected[(b * n + node) * d + i % d] += basis[1 + i / d] * r[(b * particles + p) * m + i];
      scale[(b * n + node) * d + i % d] += 30 * (std::abs(basis[1 + i / d]) + 1) * r_scale[(b * particles + p) * m + i];
    }
  });
  compare("resist", sh, e.resisted, expected, scale);
}

// Particles in the order of their cells, so that ranges of nodes share few of them.
template <class T>
void check_in_order(Shape shape, std::mt19937& random, const std::vector<const Pool*>& pools) {
  Example<T> e(shape, 0, random);
  for (int64_t p = 0; p < shape.particles; ++p) {
    for (int i = 0; i < shape.s; ++i) {  // the first axis goes up evenly; its terms are multiples of a plane's nodes
      const int64_t stride = shape.size() / shape.along, first = p * (shape.along - shape.s + 1) / shape.particles;
      e.index[i * shape.particles + p] = int32_t((first + i) * stride);
    }
  }
  check(e, pools);
  check_average(e, pools);
  check_resistance(e, pools);
}

// Solves of a batch: ‖r‖ is within its tolerance or the steps are used up, a member that may take no step is left as it
// was, and one that is not finite spoils no other. `e` has no indices beyond the window.
template <class T>
void check_solve(const Example<T>& e, std::mt19937& random, const std::vector<const Pool*>& pools) {
  const Shape& sh = e.shape;
  const int64_t n = sh.size(), size = n * sh.d, blocks = (size + kTogether - 1) / kTogether, packed = e.matrices.size;
  const Array<T> matrices(packed), mass(sh.batch * n), factor(sh.batch), weight(sh.batch * size), start(weight.size);
  const Array<T> rhs(weight.size), limits(sh.batch * kTolerances), numbers(sh.batch * kOutcome);
  const Array<bool> free(weight.size), active(sh.batch * blocks);
  std::uniform_real_distribution<T> some(1, 2);
  for (int64_t i = 0; i < packed; ++i) matrices[i] = e.matrices[i] / 10;
  for (int64_t i = 0; i < mass.size; ++i) mass[i] = some(random);
  for (int64_t i = 0; i < active.size; ++i) active[i] = random() % 4 > 0;
  for (int64_t i = 0; i < weight.size; ++i) {
    const bool zero = !active[i / size * blocks + i % size / kTogether];
    free[i] = !zero && random() % 3 > 0, weight[i] = some(random), start[i] = zero ? 0 : some(random);
    rhs[i] = free[i] ? some(random) : 0;
  }
  for (int64_t m = 0; m < sh.batch; ++m) {
    T* of = &limits[m * kTolerances];
    factor[m] = T(0.1) * (m + 1), of[0] = T(1e-2), of[1] = T(m == 0 ? 0 : 40), of[2] = T(1e-10);
  }
  const int64_t last = sh.batch - 1;
  factor[last] = std::numeric_limits<T>::quiet_NaN();
  std::unique_ptr<Array<T>> bits;
  for (const Pool* pool : pools) {
    const Array<T> x(weight.size), memory(kVectors * weight.size);
    for (int64_t i = 0; i < memory.size; ++i) memory[i] = std::numeric_limits<T>::quiet_NaN();
    Solve<T> task = {};
    task.memory = pool == pools[0] ? nullptr : memory.data.get();
    task.recurrence = {e.stencils(false), matrices.data.get(), mass.data.get(), factor.data.get(), free.data.get(),
                       weight.data.get(), active.data.get(), nullptr, x.data.get(), nullptr, nullptr, nullptr, nullptr,
                       nullptr, nullptr, n, sh.d};
    task.start = start.data.get(), task.rhs = rhs.data.get(), task.limits = limits.data.get(), task.numbers = numbers.data.get();
    if (!solve(*pool, {sh.d, sh.s, false}, sh.batch, task)) ++faults, std::printf("no kernel for a solve\n");
    bool fine = numbers[1] == 0;
    for (int64_t i = 0; i < size; ++i) fine = fine && x[i] == start[i];
    for (int64_t m = 0; m < last; ++m) {
      const T* found = &numbers[m * kOutcome];
      fine = fine && (found[1] >= limits[m * kTolerances + 1] || std::sqrt(found[0]) <= T(1e-2) * found[7]);
      for (int64_t i = 0; i < size; ++i) fine = fine && std::isfinite(x[m * size + i]);
    }
    if (!fine) ++faults, std::printf("a solve of d=%d s=%d is off\n", sh.d, sh.s);
    for (int64_t i = last * size; i < x.size; ++i) x[i] = 0;
    if (bits == nullptr) bits = std::make_unique<Array<T>>(x);
    expect_same("a solve", *bits, x);
  }
}

template <class T>
int check_all(const std::vector<const Pool*>& pools) {
  std::mt19937 random(1);
  int examples = 0;
  const auto check_both = [&](const Shape& shape, int oddity) {
    const Example<T> e(shape, oddity, random);
    check(e, pools);
    if (shape.columns > 1) check_average(e, pools);
    check_resistance(e, pools);
    ++examples;
  };
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
  check_in_order<T>({2, 3, 2, 20011, 40, 2}, random, pools);
  for (int d = 1; d <= 3; ++d) {
    for (int s = 2; s <= 4; ++s) {
      for (const int64_t particles : {0, 1, 53, 5003}) {
        check_places<T>({d, s, 1 + d % 2, particles, 20, 2 + s % 3}, int(random() % 4) - 2, random, pools), ++examples;
      }
    }
  }
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
  return examples + 1;
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
      Scatter<float> task = {e.stencils(false), {}, e.to_nodes.data.get(), nullptr, nullptr, e.shape.size(), 3, nullptr};
      task.given = {e.given.data.get(), e.given.data.get() + e.rows(), 3};
      scatter(one, {2, 3, false}, 1, task);
      const Array<float> alone(e.to_nodes);
      for (int k = 0; k < 5; ++k) {
        scatter(five, {2, 3, false}, 1, task);
        expect_same("a scatter among others", alone, e.to_nodes);
      }
    });
  }
  for (std::thread& caller : callers) caller.join();
  std::printf("%d examples, %s: %d faults\n", examples, instructions(), faults);
  return faults == 0 ? 0 : 1;
}
