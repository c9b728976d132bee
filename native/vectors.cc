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

// The sum is that of products in double, and so hardly depends on their order.
template <class T>
double combine_part(const Combine<T>& task, int64_t first, int64_t last) {
  const T s = task.scales[0], t = task.scales[1];
  double sum = 0;
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
    for (int64_t i = 0; i < count; ++i) sum += static_cast<double>(task.weight[start + i] * z[i]) * z[i];
    std::memcpy(task.y + start, y, static_cast<size_t>(count) * sizeof(T));
    std::memcpy(task.z + start, z, static_cast<size_t>(count) * sizeof(T));
  }
  return sum;
}

template <class T>
void combine_all(const Pool& pool, int64_t batch, const Combine<T>& all) {
  const int64_t blocks = (all.size + kTogether - 1) / kTogether;
  const int64_t parts = std::max<int64_t>(1, (blocks + kPart - 1) / kPart);
  std::vector<double> sums(batch * parts);
  share(pool, batch * parts, [&](int64_t i) {
    const int64_t m = i / parts, by = m * all.size, first = i % parts * kPart;
    const Combine<T> task = {all.a + by,          all.b + by,      all.c + by, all.d + by, all.scales + 2 * m,
                             all.weight + by,     all.active + m * blocks, all.y + by, all.z + by, nullptr, all.size};
    sums[i] = combine_part(task, first, std::min(blocks, first + kPart));
  });
  for (int64_t m = 0; m < batch; ++m) {
    double sum = 0;
    for (int64_t k = 0; k < parts; ++k) sum += sums[m * parts + k];
    all.sum[m] = static_cast<T>(sum);
  }
}

}  // namespace

void combine(const Pool& pool, int64_t batch, const Combine<float>& first) { combine_all(pool, batch, first); }
void combine(const Pool& pool, int64_t batch, const Combine<double>& first) { combine_all(pool, batch, first); }

}  // namespace mpmjax
