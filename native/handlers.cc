// What XLA calls: each problem as a handler of its foreign function interface, read as calls.h says. A solve returns
// memory that it worked in, of a batch of solves none.

#include <cstring>

#include "calls.h"
#include "solve.h"

namespace mpmjax {
namespace {

class XlaPool : public Pool {
 public:
  explicit XlaPool(ffi::ThreadPool pool) : pool_(pool), threads_(static_cast<int>(pool.num_threads())) {}
  int threads() const override { return threads_ > 1 ? threads_ : 1; }
  void schedule(std::function<void()> task) const override { pool_.Schedule(std::move(task)); }

 private:
  mutable ffi::ThreadPool pool_;
  int threads_;
};

template <class InFloats, class InDoubles>
ffi::Error run_on_threads(ffi::ThreadPool threads, ffi::Dictionary attributes, ffi::RemainingArgs arguments,
                          ffi::RemainingRets results) {
  return run_call<InFloats, InDoubles>(XlaPool(threads), attributes, arguments, results);
}

// Results lie where the operands do, if XLA has done what it was asked.
ffi::Error run_stored(ffi::Dictionary attributes, ffi::RemainingArgs arguments, ffi::RemainingRets results) {
  Call call(arguments, results, attributes);
  call.expect(call.buffers.size() == 2 * call.operands, "as many arrays as results");
  for (size_t k = 0; call.fault.empty() && k < call.operands; ++k) {
    const ffi::AnyBuffer &values = call.buffers[k], &result = call.buffers[call.operands + k];
    call.expect(values.size_bytes() == result.size_bytes(), "arrays of another size");
    if (!call.fault.empty() || values.untyped_data() == result.untyped_data()) continue;
    std::memcpy(result.untyped_data(), values.untyped_data(), values.size_bytes());
  }
  return call.outcome();
}

ffi::Error run_threads(ffi::ThreadPool threads, ffi::ResultBuffer<ffi::DataType::S32> count) {
  *count->typed_data() = static_cast<int32_t>(threads.num_threads());
  return ffi::Error::Success();
}

}  // namespace
}  // namespace mpmjax

#pragma GCC visibility push(default)

#define MPMJAX_HANDLER_OF(name, ...)                                                  \
  XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_##name, (mpmjax::run_on_threads<__VA_ARGS__>), \
                                ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Attrs().RemainingArgs().RemainingRets());
#define MPMJAX_HANDLER(name, Problem) MPMJAX_HANDLER_OF(name, mpmjax::Problem<float>, mpmjax::Problem<double>)
MPMJAX_PROBLEMS(MPMJAX_HANDLER)
MPMJAX_HANDLER(solve, Solve)
MPMJAX_HANDLER(combine, Combine)
MPMJAX_HANDLER(product, Product)
MPMJAX_HANDLER(rearrange, Rearrangement)
MPMJAX_HANDLER_OF(order, mpmjax::Order, mpmjax::Order)
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_stored, mpmjax::run_stored,
                              ffi::Ffi::Bind().Attrs().RemainingArgs().RemainingRets());

// The threads that sums are shared among.
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_threads, mpmjax::run_threads,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Ret<ffi::Buffer<ffi::DataType::S32>>());

// What the package asks of a library before it uses it.
extern "C" int mpmjax_interface() { return MPMJAX_INTERFACE; }
extern "C" const char* mpmjax_instructions() { return mpmjax::instructions(); }

#pragma GCC visibility pop
