// What XLA calls of passes over arrays, beside the sums of handlers.cc.
//
//   combine   a, b, c, d, scales, weight, active             ->  y, z, sum
//   product   force, v, mass, factor, free, weight, active   ->  image, sum
//   eigen     S                                              ->  w, V
//   rotation  F                                              ->  R
//   order     keys                                           ->  order
//   rearrange wanted, order, numbers                         ->  numbers
//   stored    any arrays                                     ->  the same
//
// Vectors are (..., m), scales (..., 2), mass (..., n), active (..., ⌈m/64⌉), matrices (..., 3, 3, p), w (..., 3, p), keys
// and their order (..., p), wanted (...), numbers (..., c, p), with the same leading axes everywhere.

#include <cstring>

#include "call.h"
#include "matrices.h"
#include "order.h"
#include "vectors.h"

namespace mpmjax {
namespace {

struct CombineOf {
  template <class T>
  void run(const Pool& pool, Call& call) const {
    Combine<T> task = {};
    task.size = call.dim(0, 1);
    const T** from[] = {&task.a, &task.b, &task.c, &task.d};
    for (size_t k = 0; k < 4; ++k) *from[k] = call.at<T>(k, {task.size});
    task.scales = call.at<T>(4, {2});
    task.weight = call.at<T>(5, {task.size});
    task.active = call.booleans(6, {(task.size + kChunk - 1) / kChunk});
    task.y = call.at<T>(7, {task.size});
    task.z = call.at<T>(8, {task.size});
    task.sum = call.at<T>(9, {});
    if (call.fault.empty()) combine(pool, call.batch, task);
  }
};

struct ProductOf {
  template <class T>
  void run(const Pool& pool, Call& call) const {
    Product<T> task = {};
    task.size = call.dim(0, 1);
    task.nodes = call.dim(2, 1);
    task.force = call.at<T>(0, {task.size});
    task.v = call.at<T>(1, {task.size});
    task.mass = call.at<T>(2, {task.nodes});
    task.factor = call.at<T>(3, {});
    task.free = call.booleans(4, {task.size});
    task.weight = call.at<T>(5, {task.size});
    task.active = call.booleans(6, {(task.size + kChunk - 1) / kChunk});
    task.image = call.at<T>(7, {task.size});
    task.sum = call.at<T>(8, {});
    task.whole = true;
    call.expect(task.nodes > 0 ? task.size % task.nodes == 0 : task.size == 0, "nodes with unlike numbers of components");
    if (call.fault.empty()) product(pool, call.batch, task);
  }
};

struct EigenOf {
  template <class T>
  void run(const Pool& pool, Call& call) const {
    const int64_t p = call.dim(0, 1);
    const Eigen<T> task = {call.at<T>(0, {3, 3, p}), call.at<T>(1, {3, p}), call.at<T>(2, {3, 3, p}), p};
    if (call.fault.empty()) eigen(pool, call.batch, task);
  }
};

struct RotationOf {
  template <class T>
  void run(const Pool& pool, Call& call) const {
    const int64_t p = call.dim(0, 1);
    const Rotation<T> task = {call.at<T>(0, {3, 3, p}), call.at<T>(1, {3, 3, p}), p};
    if (call.fault.empty()) rotation(pool, call.batch, task);
  }
};

// Runs a problem on so many operands and results, of the first operand's type. Leading axes are those before the last
// ones of the first operand, whose number is given.
template <class Problem, size_t operands, size_t results, size_t trailing>
ffi::Error run(ffi::ThreadPool threads, ffi::RemainingArgs from, ffi::RemainingRets to) {
  Call call = collect(from, to);
  call.expect(call.operands == operands && call.buffers.size() == operands + results, "too many or too few arrays");
  if (!call.fault.empty()) return wrong(call.fault);
  const Shape shape = shape_of(call.buffers[0]);
  if (shape.size() < trailing) return wrong("too few axes");
  call.type = call.buffers[0].element_type();
  call.lead(shape, trailing);
  const XlaPool pool(threads);
  if (call.type == ffi::DataType::F32) {
    Problem().template run<float>(pool, call);
  } else if (call.type == ffi::DataType::F64) {
    Problem().template run<double>(pool, call);
  } else {
    call.expect(false, "there is no kernel of this type");
  }
  return call.fault.empty() ? ffi::Error::Success() : wrong(call.fault);
}

ffi::Error run_order(ffi::ThreadPool threads, ffi::RemainingArgs from, ffi::RemainingRets to) {
  Call call = collect(from, to);
  call.expect(call.operands == 1 && call.buffers.size() == 2, "too many or too few arrays");
  if (!call.fault.empty()) return wrong(call.fault);
  const Shape shape = shape_of(call.buffers[0]);
  if (shape.empty()) return wrong("too few axes");
  call.type = ffi::DataType::S32;
  call.lead(shape, 1);
  const int64_t count = shape.back();
  const Order task = {call.at<int32_t>(0, {count}), call.at<int32_t>(1, {count}), count};
  if (!call.fault.empty()) return wrong(call.fault);
  order(XlaPool(threads), call.batch, task);
  return ffi::Error::Success();
}

template <class T>
void rearrange_call(const Pool& pool, Call& call, int64_t rows, int64_t count, bool inverse) {
  const bool* wanted = call.booleans(0, {});
  call.type = ffi::DataType::S32;
  const int32_t* order = call.at<int32_t>(1, {count});
  call.type = call.buffers[2].element_type();
  const Rearrangement<T> task = {wanted, order, call.at<T>(2, {rows, count}), call.at<T>(3, {rows, count}), rows, count,
                                 inverse};
  if (call.fault.empty()) rearrange(pool, call.batch, task);
}

ffi::Error run_rearrange(ffi::ThreadPool threads, bool inverse, ffi::RemainingArgs from, ffi::RemainingRets to) {
  Call call = collect(from, to);
  call.expect(call.operands == 3 && call.buffers.size() == 4, "too many or too few arrays");
  if (!call.fault.empty()) return wrong(call.fault);
  const Shape shape = shape_of(call.buffers[2]);
  if (shape.size() < 2) return wrong("too few axes");
  call.lead(shape, 2);
  const int64_t rows = shape[shape.size() - 2], count = shape.back();
  const XlaPool pool(threads);
  switch (call.buffers[2].element_type()) {
    case ffi::DataType::F32: rearrange_call<float>(pool, call, rows, count, inverse); break;
    case ffi::DataType::F64: rearrange_call<double>(pool, call, rows, count, inverse); break;
    default: call.expect(false, "there is no kernel of this type");
  }
  return call.fault.empty() ? ffi::Error::Success() : wrong(call.fault);
}

// Results lie where the operands do, if XLA has done what it was asked.
ffi::Error run_stored(ffi::RemainingArgs from, ffi::RemainingRets to) {
  Call call = collect(from, to);
  call.expect(call.buffers.size() == 2 * call.operands, "as many arrays as results");
  for (size_t k = 0; call.fault.empty() && k < call.operands; ++k) {
    const ffi::AnyBuffer &values = call.buffers[k], &result = call.buffers[call.operands + k];
    call.expect(values.size_bytes() == result.size_bytes(), "arrays of another size");
    if (!call.fault.empty() || values.untyped_data() == result.untyped_data()) continue;
    std::memcpy(result.untyped_data(), values.untyped_data(), values.size_bytes());
  }
  return call.fault.empty() ? ffi::Error::Success() : wrong(call.fault);
}

constexpr auto run_combine = run<CombineOf, 7, 3, 1>;
constexpr auto run_product = run<ProductOf, 7, 2, 1>;
constexpr auto run_eigen = run<EigenOf, 1, 2, 3>;
constexpr auto run_rotation = run<RotationOf, 1, 1, 3>;

}  // namespace
}  // namespace mpmjax

#pragma GCC visibility push(default)

XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_combine, mpmjax::run_combine,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().RemainingArgs().RemainingRets());
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_product, mpmjax::run_product,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().RemainingArgs().RemainingRets());
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_eigen, mpmjax::run_eigen,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().RemainingArgs().RemainingRets());
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_rotation, mpmjax::run_rotation,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().RemainingArgs().RemainingRets());
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_order, mpmjax::run_order,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().RemainingArgs().RemainingRets());
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_rearrange, mpmjax::run_rearrange,
                              ffi::Ffi::Bind()
                                  .Ctx<ffi::ThreadPool>()
                                  .Attr<bool>("inverse")
                                  .RemainingArgs()
                                  .RemainingRets());
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_stored, mpmjax::run_stored, ffi::Ffi::Bind().RemainingArgs().RemainingRets());

#pragma GCC visibility pop
