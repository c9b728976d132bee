// The kernels that are chosen when the library is loaded.

#include <cstdlib>
#include <cstring>

#include "kernels.h"

namespace mpmjax {

// Each is compiled from kernels.cc.
#define MPMJAX_DECLARE(target)                  \
  extern const KernelSet<float> target##_float; \
  extern const KernelSet<double> target##_double;

#if defined(MPMJAX_X86)
MPMJAX_DECLARE(avx2)
MPMJAX_DECLARE(avx512)

namespace {

// The best instruction set, or a lesser one that MPMJAX_INSTRUCTIONS names, for comparisons: avx2, or baseline, which
// is none of them.
const char* choose() {
  const char* asked = std::getenv("MPMJAX_INSTRUCTIONS");
  const auto is = [&](const char* name) { return asked != nullptr && std::strcmp(asked, name) == 0; };
  __builtin_cpu_init();
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  const bool avx512 = __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") &&
                      __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw");
  if (!avx2 || is("baseline")) return "";
  return avx512 && !is("avx2") ? "AVX-512" : "AVX2";
}

bool wide() {
  static const bool result = std::strcmp(instructions(), "AVX-512") == 0;
  return result;
}

}  // namespace

template <>
const KernelSet<float>& kernels<float>() { return wide() ? avx512_float : avx2_float; }
template <>
const KernelSet<double>& kernels<double>() { return wide() ? avx512_double : avx2_double; }
const char* instructions() {
  static const char* const chosen = choose();
  return chosen;
}

#else
MPMJAX_DECLARE(baseline)

template <>
const KernelSet<float>& kernels<float>() { return baseline_float; }
template <>
const KernelSet<double>& kernels<double>() { return baseline_double; }
#if defined(__aarch64__)
const char* instructions() { return "NEON"; }
#else
const char* instructions() { return "baseline"; }
#endif
#endif

}  // namespace mpmjax
