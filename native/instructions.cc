// The kernels that are chosen when the library is loaded.

#include <cstdlib>
#include <cstring>

#include "kernels.h"

namespace mpmjax {

// Each is compiled from kernels.cc: those that the build asked for.
#define MPMJAX_DECLARE(target)                  \
  extern const KernelSet<float> target##_float; \
  extern const KernelSet<double> target##_double;
MPMJAX_DECLARE(avx2)
MPMJAX_DECLARE(avx512)
MPMJAX_DECLARE(baseline)

#if defined(MPMJAX_AVX2) && defined(MPMJAX_AVX512)
#define MPMJAX_CHOSEN(number) (std::strcmp(instructions(), "AVX2") == 0 ? avx2_##number : avx512_##number)
#elif defined(MPMJAX_AVX2)
#define MPMJAX_CHOSEN(number) avx2_##number
#elif defined(MPMJAX_AVX512)
#define MPMJAX_CHOSEN(number) avx512_##number
#else
#define MPMJAX_CHOSEN(number) baseline_##number
#endif

template <>
const KernelSet<float>& kernels<float>() { return MPMJAX_CHOSEN(float); }
template <>
const KernelSet<double>& kernels<double>() { return MPMJAX_CHOSEN(double); }

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

}  // namespace mpmjax
