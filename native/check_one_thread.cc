// The sums of one_thread.h as XLA calls them on a CPU, one thread after the other: what tests/test_cuda.py builds.

#include <cstring>
#include <utility>

#include "launches.h"

namespace mpmjax {
namespace {

template <int n>
using Constant = std::integral_constant<int, n>;

// Calls run(constant) for a number from a first to before a last.
template <int first, int last, class Run>
void with_constant(int n, const Run& run) {
  if constexpr (first < last) {
    if (n == first) return run(Constant<first>());
    with_constant<first + 1, last>(n, run);
  }
}

struct OneByOne {
  template <class T>
  void clear(T* numbers, int64_t count) const {
    std::memset(numbers, 0, count * sizeof(T));
  }

  template <class Problem, class Run>
  void launch(const char*, const char*, const Problem& all, int columns, int64_t count, int64_t batch,
              const Run& run) const {
    const auto& basis = all.stencils.basis;
    with_constant<1, 4>(basis.d, [&](auto d) {
      with_constant<2, 5>(basis.s, [&](auto s) {
        with_constant<0, 5>(columns, [&](auto c) {
          for (int64_t m = 0; m < batch; ++m) {
            const Problem one = member(all, m);
            for (int64_t i = 0; i < count; ++i) run(d, s, c, one, i);
          }
        });
      });
    });
  }
};

template <auto for_floats, auto for_doubles>
ffi::Error run(ffi::Dictionary attributes, ffi::RemainingArgs arguments, ffi::RemainingRets results) {
  return run_on<for_floats, for_doubles, 2, 1>(OneByOne(), attributes, arguments, results);
}

}  // namespace
}  // namespace mpmjax

#define MPMJAX_HANDLER(name)                                                                                          \
  XLA_FFI_DEFINE_HANDLER_SYMBOL(                                                                                      \
      mpmjax_##name, (mpmjax::run<mpmjax::call_##name<float, mpmjax::OneByOne>,                                       \
                                  mpmjax::call_##name<double, mpmjax::OneByOne>>),                                    \
      ffi::Ffi::Bind().Attrs().RemainingArgs().RemainingRets());
MPMJAX_HANDLER(gather)
MPMJAX_HANDLER(scatter)
MPMJAX_HANDLER(average)
MPMJAX_HANDLER(pull)
MPMJAX_HANDLER(resist)
