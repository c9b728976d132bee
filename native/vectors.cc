#include "vectors.h"

#include <algorithm>
#include <vector>

#include "instructions.h"

namespace mpmjax {
namespace {

constexpr int64_t kPart = 128;  // times 64 numbers, some microseconds: what a thread takes at a time

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

}  // namespace

template <class T>
void combine(const Pool& pool, int64_t batch, const Combine<T>& all) {
  const int64_t blocks = (all.size + kChunk - 1) / kChunk;
  over_blocks(pool, batch, blocks, all.sum, [&](int64_t m, int64_t first, int64_t last) {
    const int64_t by = m * all.size;
    const Combine<T> task = {all.a + by,      all.b + by,               all.c + by, all.d + by, all.scales + 2 * m,
                             all.weight + by, all.active + m * blocks, all.y + by, all.z + by, nullptr, all.size};
    return kernels<T>().combine(task, first, last);
  });
}

template <class T>
void product(const Pool& pool, int64_t batch, const Product<T>& all) {
  const int64_t blocks = (all.size + kChunk - 1) / kChunk;
  over_blocks(pool, batch, blocks, all.sum, [&](int64_t m, int64_t first, int64_t last) {
    const int64_t by = m * all.size;
    const Product<T> task = {all.force + by,  all.v + by,               all.mass + m * all.nodes, all.factor + m,
                             all.free + by,   all.weight + by,          all.active + m * blocks,  all.image + by,
                             nullptr,         all.size,                 all.nodes,                all.whole};
    return kernels<T>().product(task, first, last);
  });
}

template void combine(const Pool&, int64_t, const Combine<float>&);
template void combine(const Pool&, int64_t, const Combine<double>&);
template void product(const Pool&, int64_t, const Product<float>&);
template void product(const Pool&, int64_t, const Product<double>&);

}  // namespace mpmjax
