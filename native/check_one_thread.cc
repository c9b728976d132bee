// The kernels for cards as XLA calls them on a CPU: what tests/test_cuda.py builds.

#include "calls.h"
#include "one_by_one.h"

namespace mpmjax {
namespace {

template <template <class> class Problem>
ffi::Error run_one_by_one(ffi::Dictionary attributes, ffi::RemainingArgs arguments, ffi::RemainingRets results) {
  return run_call<Problem<float>, Problem<double>>(OneByOne<4>(), attributes, arguments, results);
}

}  // namespace
}  // namespace mpmjax

#define MPMJAX_HANDLER(name, Problem)                                                      \
  XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_##name, mpmjax::run_one_by_one<mpmjax::Problem>, \
                                ffi::Ffi::Bind().Attrs().RemainingArgs().RemainingRets());
MPMJAX_PROBLEMS(MPMJAX_HANDLER)
