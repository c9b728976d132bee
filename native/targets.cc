#include "targets.h"

#include <cstdlib>
#include <cstring>

namespace mpmjax {
namespace {

enum class Target { baseline, avx2, avx512 };

Target found() {
#if defined(MPMJAX_X86)
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("fma")) {
    return Target::avx512;
  }
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return Target::avx2;
#endif
  return Target::baseline;
}

// The one found, or a lesser one that MPMJAX_INSTRUCTIONS names, for comparisons.
Target chosen() {
  const Target best = found();
  const char* asked = std::getenv("MPMJAX_INSTRUCTIONS");
  if (asked == nullptr) return best;
  if (std::strcmp(asked, "baseline") == 0) return Target::baseline;
  if (std::strcmp(asked, "avx2") == 0 && best == Target::avx512) return Target::avx2;
  return best;
}

Target target() {
  static const Target once = chosen();
  return once;
}

template <class T>
const Kernels<T>* of(int d, int s, bool differential) {
  switch (target()) {
#if defined(MPMJAX_X86)
    case Target::avx512: return kernels_avx512(T(), d, s, differential);
    case Target::avx2: return kernels_avx2(T(), d, s, differential);
#endif
    default: return kernels_baseline(T(), d, s, differential);
  }
}

template <class T>
const ArrayKernels<T>& arrays_of() {
  switch (target()) {
#if defined(MPMJAX_X86)
    case Target::avx512: return array_kernels_avx512(T());
    case Target::avx2: return array_kernels_avx2(T());
#endif
    default: return array_kernels_baseline(T());
  }
}

}  // namespace

const Kernels<float>* kernels(float, int d, int s, bool differential) { return of<float>(d, s, differential); }
const Kernels<double>* kernels(double, int d, int s, bool differential) { return of<double>(d, s, differential); }
const ArrayKernels<float>& array_kernels(float) { return arrays_of<float>(); }
const ArrayKernels<double>& array_kernels(double) { return arrays_of<double>(); }

const char* instructions() {
  switch (target()) {
    case Target::avx512: return "AVX-512";
    case Target::avx2: return "AVX2";
    default:
#if defined(MPMJAX_X86)
      return "SSE2";
#elif defined(__aarch64__)
      return "NEON";
#else
      return "baseline";
#endif
  }
}

}  // namespace mpmjax
