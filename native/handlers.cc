// What XLA calls: each problem as a handler of its foreign function interface.
//
// Operands and results are the arrays that a problem lists, with the same leading axes everywhere. Particles give a
// value or gradients or both, and gradients may have fewer columns than the value. A pull returns the gather or not; an
// average and a solve return memory that they worked in, of a batch of solves none. Attributes of a sum are the basis,
// whether there is a value, `valued`, and whether there is dt, `differential`; of `rearrange` it is `inverse`.

#include <cstring>

#include "call.h"

namespace mpmjax {
namespace {

// The sizes and polynomials of a sum's stencils.
template <class T>
void take_stencils(Call& call, Stencils<T>& stencils) {
  ffi::Span<const int64_t> shape, periodic;
  ffi::Span<const double> knots, weights, slopes;
  call.take("shape", shape), call.take("periodic", periodic);
  call.take("knots", knots), call.take("weights", weights), call.take("slopes", slopes);
  const int64_t d = call.dim(0, 2), s = static_cast<int64_t>(knots.size());
  const int64_t terms = s > 0 ? static_cast<int64_t>(weights.size()) / s : 0;
  call.expect(d >= 1 && d <= kMostAxes, "no dimension of one to three");
  call.expect(int64_t(shape.size()) == d && int64_t(periodic.size()) == d, "no number of nodes for each axis");
  call.expect(s >= 2 && s <= kMostNodes, "there is no kernel of this order");
  call.expect(int64_t(weights.size()) == terms * s && terms <= kMostTerms && slopes.size() == weights.size(),
              "no coefficients (s, terms) of both families");
  for (const int64_t n : shape) call.expect(n > 0 && n <= INT32_MAX, "axes without nodes");
  if (!call.fault.empty()) return;
  stencils.particles = call.dim(0, 1);
  Basis<T>& basis = stencils.basis;
  basis.d = static_cast<int>(d), basis.s = static_cast<int>(s), basis.terms = static_cast<int>(terms);
  for (int64_t a = d - 1, stride = 1; a >= 0; stride *= shape[a--]) {
    basis.shape[a] = static_cast<int32_t>(shape[a]), basis.strides[a] = static_cast<int32_t>(stride);
    basis.periodic[a] = periodic[a] != 0;
  }
  for (int64_t i = 0; i < s; ++i) {
    basis.knots[i] = static_cast<T>(knots[i]);
    for (int64_t k = 0; k < terms; ++k) {
      basis.weights[i][k] = static_cast<T>(weights[i * terms + k]);
      basis.slopes[i][k] = static_cast<T>(slopes[i * terms + k]);
    }
  }
}

// A sum whose k-th array is that of the nodes.
template <class Problem>
Problem sum_of(Call& call, size_t k) {
  Problem task = {};
  take_stencils(call, task.stencils);
  task.size = call.dim(k, 2), task.columns = call.dim(k, 1);
  call.expect(task.size > 0 || task.stencils.particles == 0 || k >= call.operands, "no nodes to gather from");
  return task;
}

// Whether gradients are given, of operands that end with a value, if there is one, from the k-th on.
template <class Problem>
bool take_graded(Call& call, Problem& task, size_t k, bool valued) {
  const bool graded = call.operands > k + valued;
  if (graded) task.values.graded = call.dim(k + valued, 2);
  call.expect(task.values.graded <= task.columns, "more columns of gradients than of nodes");
  return graded;
}

template <class T>
void call_gather(const Pool& pool, Call& call) {
  const bool moved = call.flag("differential");
  auto task = sum_of<Gather<T>>(call, 2 + moved);
  if (call.read(task, 3 + moved, 2, {true, true, moved})) gather(pool, call.batch, task);
}

template <class T>
void call_scatter(const Pool& pool, Call& call) {
  const bool moved = call.flag("differential"), valued = call.flag("valued");
  auto task = sum_of<Scatter<T>>(call, call.operands);
  const bool graded = take_graded(call, task, 2 + moved, valued);
  const size_t operands = 2 + moved + valued + graded;
  if (call.read(task, operands, 1, {true, true, moved, valued, graded})) scatter(pool, call.batch, task);
}

template <class T>
void call_average(const Pool& pool, Call& call) {
  auto task = sum_of<Average<T>>(call, call.operands + 2);
  const bool graded = take_graded(call, task, 3, true);
  if (call.read(task, 4 + graded, 3, {true, true, false, true, true, graded})) average(pool, call.batch, task);
}

template <class T>
void call_pull(const Pool& pool, Call& call) {
  const bool valued = call.flag("valued"), gathers = call.buffers.size() > call.operands + 1;
  auto task = sum_of<Pull<T>>(call, 2);
  const bool graded = take_graded(call, task, 3, valued);
  const size_t operands = 3 + valued + graded, results = gathers ? 3 : 1;
  if (call.read(task, operands, results, {true, true, false, true, valued, graded})) pull(pool, call.batch, task);
}

template <class T>
void call_resist(const Pool& pool, Call& call) {
  auto task = sum_of<Resist<T>>(call, 3);
  call.expect(task.columns == task.stencils.basis.d, "a displacement of another dimension");
  if (call.read(task, 4, 1, {true, true, false})) resist(pool, call.batch, task, divided(pool, call.batch, task));
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

// Runs what is for floats or for doubles, as the operand `like` says. The first operand has so many trailing axes.
template <auto for_floats, auto for_doubles, size_t trailing, size_t like>
ffi::Error run(ffi::ThreadPool threads, ffi::Dictionary attributes, ffi::RemainingArgs arguments,
               ffi::RemainingRets results) {
  Call call(arguments, results, attributes, trailing);
  if (!call.fault.empty()) return call.outcome();
  const ffi::DataType type = like < call.buffers.size() ? call.buffers[like].element_type() : ffi::DataType::INVALID;
  if (type == ffi::DataType::F32 || for_floats == for_doubles) {
    for_floats(XlaPool(threads), call);
  } else if (type == ffi::DataType::F64) {
    for_doubles(XlaPool(threads), call);
  } else {
    call.expect(false, "there is no kernel of this type");
  }
  return call.outcome();
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
