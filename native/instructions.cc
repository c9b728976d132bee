#include "instructions.h"

#include <cstdlib>
#include <cstring>

namespace mpmjax {

// Each is compiled from kernels.cc.
#define MPMJAX_DECLARE(target)                \
  extern const KernelSet<float> target##_float; \
  extern const KernelSet<double> target##_double;
#if defined(MPMJAX_X86)
MPMJAX_DECLARE(avx2)
MPMJAX_DECLARE(avx512)
#else
MPMJAX_DECLARE(baseline)
#endif

namespace {

struct InstructionSet {
  const char* name;
  const KernelSet<float>& floats;
  const KernelSet<double>& doubles;
};

#if defined(MPMJAX_X86)
// The best one, or a lesser one that MPMJAX_INSTRUCTIONS names, for comparisons: avx2, or baseline, which is none of them.
InstructionSet choose() {
  const char* asked = std::getenv("MPMJAX_INSTRUCTIONS");
  const auto is = [&](const char* name) { return asked != nullptr && std::strcmp(asked, name) == 0; };
  __builtin_cpu_init();
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  const bool avx512 = avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") &&
                      __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw");
  if (!avx2 || is("baseline")) return {"", avx2_float, avx2_double};
  if (!avx512 || is("avx2")) return {"AVX2", avx2_float, avx2_double};
  return {"AVX-512", avx512_float, avx512_double};
}
#elif defined(__aarch64__)
InstructionSet choose() { return {"NEON", baseline_float, baseline_double}; }
#else
InstructionSet choose() { return {"baseline", baseline_float, baseline_double}; }
#endif

const InstructionSet& chosen() {
  static const InstructionSet once = choose();
  return once;
}

}  // namespace

template <>
const KernelSet<float>& kernels<float>() {
  return chosen().floats;
}

template <>
const KernelSet<double>& kernels<double>() {
  return chosen().doubles;
}

const char* instructions() { return chosen().name; }

}  // namespace mpmjax
