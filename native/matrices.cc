#include "matrices.h"

#include <algorithm>

#include "instructions.h"

namespace mpmjax {
namespace {

constexpr int64_t kPart = 4096;  // particles that a thread takes at a time

// Calls run(m, first, last) for parts of the particles of each of a batch.
template <class Run>
void over_particles(const Pool& pool, int64_t batch, int64_t particles, const Run& run) {
  const int64_t parts = (particles + kPart - 1) / kPart;
  share(pool, batch * parts, [&](int64_t i) {
    const int64_t first = i % parts * kPart;
    run(i / parts, first, std::min(particles, first + kPart));
  });
}

}  // namespace

template <class T>
void eigen(const Pool& pool, int64_t batch, const Eigen<T>& all) {
  const int64_t n = all.particles;
  over_particles(pool, batch, n, [&](int64_t m, int64_t first, int64_t last) {
    kernels<T>().eigen({all.matrices + 9 * n * m, all.values + 3 * n * m, all.vectors + 9 * n * m, n}, first, last);
  });
}

template <class T>
void rotation(const Pool& pool, int64_t batch, const Rotation<T>& all) {
  const int64_t n = all.particles;
  over_particles(pool, batch, n, [&](int64_t m, int64_t first, int64_t last) {
    kernels<T>().rotation({all.matrices + 9 * n * m, all.rotations + 9 * n * m, n}, first, last);
  });
}

template void eigen(const Pool&, int64_t, const Eigen<float>&);
template void eigen(const Pool&, int64_t, const Eigen<double>&);
template void rotation(const Pool&, int64_t, const Rotation<float>&);
template void rotation(const Pool&, int64_t, const Rotation<double>&);

}  // namespace mpmjax
