// What XLA calls: each problem as a handler of its foreign function interface.
//
// Sums are read as calls.h says, and others as they are. A solve returns memory that it worked in, of a batch of solves
// none. The attribute of `rearrange` is `inverse`.

#include <cstring>

#include "calls.h"

namespace mpmjax {
namespace {

// Which of C, A and B there are say the attributes `affine`, `pushed` and `factored`.
template <class T>
void call_p2g(const Pool& pool, Call& call) {
  const bool affine = call.flag("affine"), pushed = call.flag("pushed"), factored = call.flag("factored");
  const bool isotropic = call.flag("isotropic"), bent = isotropic && factored;
  auto task = sum_of<P2G<T>>(call, call.operands + 2);
  call.expect(task.columns == task.stencils.basis.d + 1, "nodes of another dimension");
  const std::initializer_list<bool> present = {true, true,   false,  true,     true,      true,     true,
                                               true, affine, pushed, factored, bent,      isotropic};
  const size_t operands = 7 + affine + pushed + factored + bent + isotropic;
  if (call.read(task, operands, 3, present)) p2g(pool, call.batch, task);
}

template <class T>
void call_g2p(const Pool& pool, Call& call) {
  const bool strained = call.operands > 6;
  auto task = sum_of<G2P<T>>(call, 2);
  call.expect(task.columns == task.stencils.basis.d, "a velocity of another dimension");
  if (call.read(task, 6 + strained, 3 + strained, {true, true, false, true, true, true, true, strained})) {
    g2p(pool, call.batch, task);
  }
}

template <class T>
void call_solve(const Pool& pool, Call& call) {
  Solve<T> task = {};
  take_stencils(call, task.stencils);
  task.nodes = call.dim(3, 1), task.columns = task.stencils.basis.d;
  task.room = call.leading.empty() ? kVectors * task.nodes * task.columns : 0;
  call.expect(task.nodes > 0 || task.stencils.particles == 0, "no nodes to gather from");
  if (call.read(task, 11, 3, {true, true, false})) solve(pool, call.batch, task);
}

template <class T>
void call_combine(const Pool& pool, Call& call) {
  Combine<T> task = {};
  task.size = call.dim(0, 1);
  if (call.read(task, 7, 3)) combine(pool, call.batch, task);
}

template <class T>
void call_product(const Pool& pool, Call& call) {
  Product<T> task = {};
  task.size = call.dim(0, 1), task.nodes = call.dim(2, 1), task.whole = true;
  call.expect(task.nodes > 0 ? task.size % task.nodes == 0 : task.size == 0, "nodes with unlike numbers of components");
  if (call.read(task, 7, 2)) product(pool, call.batch, task);
}

template <class T>
void call_eigen(const Pool& pool, Call& call) {
  Eigen<T> task = {nullptr, nullptr, nullptr, call.dim(0, 1)};
  if (call.read(task, 1, 2)) eigen(pool, call.batch, task);
}

template <class T>
void call_rotation(const Pool& pool, Call& call) {
  Rotation<T> task = {nullptr, nullptr, call.dim(0, 1)};
  if (call.read(task, 1, 1)) rotation(pool, call.batch, task);
}

void call_order(const Pool& pool, Call& call) {
  Order task = {nullptr, nullptr, call.dim(0, 1)};
  if (call.read(task, 1, 1)) order(pool, call.batch, task);
}

template <class T>
void call_rearrange(const Pool& pool, Call& call) {
  Rearrangement<T> task = {nullptr, nullptr, nullptr, nullptr, call.dim(2, 2), call.dim(2, 1), call.flag("inverse")};
  if (call.read(task, 3, 1)) rearrange(pool, call.batch, task);
}

template <auto for_floats, auto for_doubles, size_t trailing, size_t like>
ffi::Error run(ffi::ThreadPool threads, ffi::Dictionary attributes, ffi::RemainingArgs arguments,
               ffi::RemainingRets results) {
  return run_on<for_floats, for_doubles, trailing, like>(XlaPool(threads), attributes, arguments, results);
}

// Results lie where the operands do, if XLA has done what it was asked.
ffi::Error run_stored(ffi::Dictionary attributes, ffi::RemainingArgs arguments, ffi::RemainingRets results) {
  Call call(arguments, results, attributes, 0);
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

#define MPMJAX_HANDLER(name, ...)                                          \
  XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_##name, (mpmjax::run<__VA_ARGS__>), \
                                ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Attrs().RemainingArgs().RemainingRets());
#define MPMJAX_HANDLERS(name, trailing, like) \
  MPMJAX_HANDLER(name, mpmjax::call_##name<float>, mpmjax::call_##name<double>, trailing, like)
MPMJAX_HANDLERS(gather, 2, 1)
MPMJAX_HANDLERS(scatter, 2, 1)
MPMJAX_HANDLERS(average, 2, 1)
MPMJAX_HANDLERS(pull, 2, 1)
MPMJAX_HANDLERS(p2g, 2, 1)
MPMJAX_HANDLERS(g2p, 2, 1)
MPMJAX_HANDLERS(resist, 2, 1)
MPMJAX_HANDLERS(solve, 2, 1)
MPMJAX_HANDLERS(combine, 1, 0)
MPMJAX_HANDLERS(product, 1, 0)
MPMJAX_HANDLERS(eigen, 3, 0)
MPMJAX_HANDLERS(rotation, 3, 0)
MPMJAX_HANDLERS(rearrange, 0, 2)
MPMJAX_HANDLER(order, mpmjax::call_order, mpmjax::call_order, 1, 0)
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_stored, mpmjax::run_stored,
                              ffi::Ffi::Bind().Attrs().RemainingArgs().RemainingRets());

// The threads that sums are shared among.
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_threads, mpmjax::run_threads,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Ret<ffi::Buffer<ffi::DataType::S32>>());

// What the package asks of a library before it uses it.
extern "C" int mpmjax_interface() { return MPMJAX_INTERFACE; }
extern "C" const char* mpmjax_instructions() { return mpmjax::instructions(); }

#pragma GCC visibility pop
