// The kernels that are chosen when the library is loaded.

#include <cstdlib>
#include <cstring>

#include "kernels.h"

namespace mpmjax {

namespace {

// The best instruction set, or a lesser one that MPMJAX_INSTRUCTIONS names, for comparisons: avx2, or baseline, which
// is none of them.
const char* choose() {
#if defined(MPMJAX_AVX2) || defined(MPMJAX_AVX512)
  const char* asked = std::getenv("MPMJAX_INSTRUCTIONS");
  const auto is = [&](const char* name) { return asked != nullptr && std::strcmp(asked, name) == 0; };
  __builtin_cpu_init();
#if defined(MPMJAX_AVX512)
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512bw") && !is("avx2") && !is("baseline")) {
    return "AVX-512";
  }
#endif
#if defined(MPMJAX_AVX2)
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && !is("baseline")) return "AVX2";
#endif
  return "";
#elif defined(__aarch64__)
  return "NEON";
#else
  return "baseline";
#endif
}

}  // namespace

const char* instructions() {
  static const char* const chosen = choose();
  return chosen;
}

template <class T>
const KernelSet<T>& kernels() {
#if defined(MPMJAX_AVX2) && defined(MPMJAX_AVX512)
  return std::strcmp(instructions(), "AVX2") == 0 ? Compiled<avx2, T>::kernels : Compiled<avx512, T>::kernels;
#elif defined(MPMJAX_AVX2)
  return Compiled<avx2, T>::kernels;
#elif defined(MPMJAX_AVX512)
  return Compiled<avx512, T>::kernels;
#else
  return Compiled<baseline, T>::kernels;
#endif
}
template const KernelSet<float>& kernels();
template const KernelSet<double>& kernels();

}  // namespace mpmjax
