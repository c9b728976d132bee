#include "vectors.h"

#include <algorithm>
#include <cstring>
#include <vector>

namespace mpmjax {
namespace {

constexpr int64_t kPart = 512;  // times 64 numbers: what a thread takes at a time

template <class T>
void clear(T* result, const T* one, const T* other, int64_t first, int64_t count) {
  if (result != one && result != other) std::memset(result + first, 0, static_cast<size_t>(count) * sizeof(T));
}

// A sum in double, which hardly depends on the order of its terms: eight sums side by side, that one needs not wait for
// another.
class Sum {
 public:
  // Calls term(i) for i from zero to count, at most kTogether.
  template <class Term>
  void add(int64_t count, const Term& term) {
    double terms[kTogether] = {};
    for (int64_t i = 0; i < count; ++i) terms[i] = term(i);
    for (int64_t i = 0; i < kTogether; i += kLanes) {
      for (int64_t k = 0; k < kLanes; ++k) sums_[k] += terms[i + k];
    }
  }

  double total() const {
    double total = 0;
    for (const double sum : sums_) total += sum;
    return total;
  }

 private:
  static constexpr int64_t kLanes = 8;
  double sums_[kLanes] = {};
};

template <class T>
double combine_part(const Combine<T>& task, int64_t first, int64_t last) {
  const T s = task.scales[0], t = task.scales[1];
  Sum sum;
  for (int64_t k = first; k < last; ++k) {
    const int64_t start = k * kTogether, count = std::min(kTogether, task.size - start);
    if (!task.active[k]) {
      clear(task.y, task.a, task.b, start, count);
      clear(task.z, task.c, task.d, start, count);
      continue;
    }
    T y[kTogether], z[kTogether];  // the results may lie where the vectors are
    for (int64_t i = 0; i < count; ++i) y[i] = task.a[start + i] + s * task.b[start + i];
    for (int64_t i = 0; i < count; ++i) z[i] = task.c[start + i] + t * task.d[start + i];
    sum.add(count, [&](int64_t i) { return static_cast<double>(task.weight[start + i] * z[i]) * z[i]; });
    std::memcpy(task.y + start, y, static_cast<size_t>(count) * sizeof(T));
    std::memcpy(task.z + start, z, static_cast<size_t>(count) * sizeof(T));
  }
  return sum.total();
}

template <class T>
double product_part(const Product<T>& task, int64_t first, int64_t last) {
  const T factor = task.factor[0];
  const int64_t each = task.nodes > 0 ? task.size / task.nodes : 1;
  Sum sum;
  for (int64_t k = first; k < last; ++k) {
    const int64_t start = k * kTogether, count = std::min(kTogether, task.size - start);
    if (!task.active[k]) {
      if (task.whole) std::memset(task.image + start, 0, static_cast<size_t>(count) * sizeof(T));
      continue;
    }
    T mass[kTogether], image[kTogether];  // the image may lie where the force is
    for (int64_t i = 0, node = start / each, part = start % each; i < count; ++i) {
      mass[i] = task.mass[node];
      if (++part == each) part = 0, ++node;
    }
    for (int64_t i = 0; i < count; ++i) {
      const T v = task.v[start + i], pushed = mass[i] * v + factor * task.force[start + i];
      image[i] = task.free[start + i] ? pushed : v;
    }
    sum.add(count, [&](int64_t i) { return static_cast<double>(task.v[start + i]) * image[i]; });
    for (int64_t i = 0; i < count; ++i) task.image[start + i] = image[i] / task.weight[start + i];
  }
  return sum.total();
}

// Calls run(m, first, last) for parts of the blocks of each of a batch, and adds up what it returns: the same parts in the
// same order for any number of threads.
template <class T, class Run>
void over_blocks(const Pool& pool, int64_t batch, int64_t blocks, T* to, const Run& run) {
  const int64_t parts = std::max<int64_t>(1, (blocks + kPart - 1) / kPart);
  std::vector<double> sums(batch * parts);
  share(pool, batch * parts, [&](int64_t i) {
    const int64_t first = i % parts * kPart;
    sums[i] = run(i / parts, first, std::min(blocks, first + kPart));
  });
  for (int64_t m = 0; m < batch; ++m) {
    double sum = 0;
    for (int64_t k = 0; k < parts; ++k) sum += sums[m * parts + k];
    to[m] = static_cast<T>(sum);
  }
}

template <class T>
void combine_all(const Pool& pool, int64_t batch, const Combine<T>& all) {
  const int64_t blocks = (all.size + kTogether - 1) / kTogether;
  over_blocks(pool, batch, blocks, all.sum, [&](int64_t m, int64_t first, int64_t last) {
    const int64_t by = m * all.size;
    const Combine<T> task = {all.a + by,      all.b + by,               all.c + by, all.d + by, all.scales + 2 * m,
                             all.weight + by, all.active + m * blocks, all.y + by, all.z + by, nullptr, all.size};
    return combine_part(task, first, last);
  });
}

template <class T>
void product_all(const Pool& pool, int64_t batch, const Product<T>& all) {
  const int64_t blocks = (all.size + kTogether - 1) / kTogether;
  over_blocks(pool, batch, blocks, all.sum, [&](int64_t m, int64_t first, int64_t last) {
    const int64_t by = m * all.size;
    const Product<T> task = {all.force + by,  all.v + by,               all.mass + m * all.nodes, all.factor + m,
                             all.free + by,   all.weight + by,          all.active + m * blocks,  all.image + by,
                             nullptr,         all.size,                 all.nodes,                all.whole};
    return product_part(task, first, last);
  });
}

}  // namespace

void combine(const Pool& pool, int64_t batch, const Combine<float>& first) { combine_all(pool, batch, first); }
void combine(const Pool& pool, int64_t batch, const Combine<double>& first) { combine_all(pool, batch, first); }
void product(const Pool& pool, int64_t batch, const Product<float>& first) { product_all(pool, batch, first); }
void product(const Pool& pool, int64_t batch, const Product<double>& first) { product_all(pool, batch, first); }

}  // namespace mpmjax
