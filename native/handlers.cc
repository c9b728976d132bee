// What XLA calls: each sum as a handler of its foreign function interface. Operands are checked against each other, so
// that nothing is read or written beyond them.
//
//   gather   index, weights, derivatives [, their changes], nodes      ->  a, a_b
//   scatter  index, weights, derivatives [, their changes], given ...  ->  nodes
//   average  index, weights, derivatives, least, given ...             ->  whole, means, memory to work in
//   pull     index, weights, derivatives, nodes, given ...             ->  by weights, by derivatives [, a, a_b]
//   resist   index, weights, derivatives, matrices, nodes              ->  nodes
//   solve    index, weights, derivatives, matrices, mass, factor, free, weight, active, x, rhs, limits  ->  x, numbers,
//                                                                         memory to work in (of a batch none)
//
// With `placed`, all but a pull are given first nodes (..., d, p), strides (..., d), offsets (..., d, p) and polynomials
// (..., 2, s, s + 2) in place of the factors.
//
// Factors are (..., d, s, p), values (..., c, p) and gradients (..., d, c, p), nodes (..., n, c), matrices
// (..., d² (d² + 1) / 2, p), with the same leading axes everywhere. Given are a value or gradients or both; gradients may
// have fewer columns than the value. In a solve vectors are (..., n d), mass (..., n), active (..., ⌈n d/64⌉).
// `valued` says whether there is a value; `differential` whether changes of the factors follow them.

#include "call.h"
#include "solve.h"
#include "sums.h"
#include "targets.h"
#include "vectors.h"

namespace mpmjax {
namespace {

// A sum's call, with the sizes that its index and weights, or its places, have.
Call read(bool placed, const ffi::RemainingArgs& arguments, const ffi::RemainingRets& results) {
  Call call = collect(arguments, results);
  call.placed = placed;
  call.expect(call.operands > call.factors(false), "an array is missing");
  if (!call.fault.empty()) return call;
  const Shape shape = shape_of(call.buffers[0]);
  if (placed) {
    call.expect(shape.size() >= 2 && call.buffers[0].element_type() == ffi::DataType::S32, "no first nodes (..., d, p)");
    if (!call.fault.empty()) return call;
    call.type = call.buffers[2].element_type();
    call.lead(shape, 2);
    call.d = shape[shape.size() - 2];
    call.s = call.dim(3, 2);
    call.particles = shape.back();
    call.expect(call.d >= 1 && call.d <= kMostAxes, "no dimension of one to three");
    return call;
  }
  call.expect(shape.size() >= 3 && call.buffers[0].element_type() == ffi::DataType::S32, "no index (..., d, s, p)");
  if (!call.fault.empty()) return call;
  call.type = call.buffers[1].element_type();
  call.lead(shape, 3);
  call.d = shape[shape.size() - 3];
  call.s = shape[shape.size() - 2];
  call.particles = shape.back();
  call.expect(call.d >= 1 && call.d <= kMostAxes, "no dimension of one to three");
  return call;
}

// One problem of each kind from a call; `run` sums it.
struct GatherOf {
  bool differential;

  template <class T>
  bool run(const Pool& pool, Call& call) const {
    const size_t k = call.factors(differential);
    Gather<T> task = {};
    task.stencils = call.stencils<T>(differential);
    task.size = call.dim(k, 2);
    task.columns = call.dim(k, 1);
    task.nodes = call.at<T>(k, {task.size, task.columns});
    call.expect(call.operands == k + 1 && call.buffers.size() == k + 3, "too many or too few arrays");
    call.expect(task.size > 0 || call.particles == 0, "no nodes to gather from");
    task.value = call.at<T>(k + 1, {task.columns, call.particles});
    task.gradients = call.at<T>(k + 2, {call.d, task.columns, call.particles});
    if (!call.fault.empty()) return true;
    return gather(pool, {int(call.d), int(call.s), differential}, call.batch, task);
  }
};

struct ScatterOf {
  bool differential, valued;

  template <class T>
  bool run(const Pool& pool, Call& call) const {
    const size_t k = call.factors(differential);
    Scatter<T> task = {};
    task.stencils = call.stencils<T>(differential);
    task.size = call.dim(call.operands, 2);
    task.columns = call.dim(call.operands, 1);
    task.nodes = call.at<T>(call.operands, {task.size, task.columns});
    call.expect(call.buffers.size() == call.operands + 1, "too many or too few results");
    task.given = call.given<T>(k, valued, task.columns);
    if (!call.fault.empty()) return true;
    return scatter(pool, {int(call.d), int(call.s), differential}, call.batch, task);
  }
};

struct AverageOf {
  template <class T>
  bool run(const Pool& pool, Call& call) const {
    const size_t k = call.factors(false);
    Average<T> task = {};
    task.stencils = call.stencils<T>(false);
    task.least = call.at<T>(k, {});
    task.size = call.dim(call.operands, 1);
    task.columns = call.dim(k + 1, 2);
    task.given = call.given<T>(k + 1, true, task.columns);
    task.whole = call.at<T>(call.operands, {task.size});
    task.means = call.at<T>(call.operands + 1, {task.size, task.columns - 1});
    task.sums = call.at<T>(call.operands + 2, {task.size, task.columns});
    call.expect(call.buffers.size() == call.operands + 3, "too many or too few results");
    if (!call.fault.empty()) return true;
    return average(pool, {int(call.d), int(call.s), false}, call.batch, task);
  }
};

struct PullOf {
  bool valued;

  template <class T>
  bool run(const Pool& pool, Call& call) const {
    Pull<T> task = {};
    task.stencils = call.stencils<T>(false);
    task.size = call.dim(3, 2);
    task.columns = call.dim(3, 1);
    task.nodes = call.at<T>(3, {task.size, task.columns});
    task.given = call.given<T>(4, valued, task.columns);
    const bool gathers = call.buffers.size() == call.operands + 4;
    call.expect(gathers || call.buffers.size() == call.operands + 2, "too many or too few results");
    call.expect(task.size > 0 || call.particles == 0, "no nodes to gather from");
    task.by_weights = call.at<T>(call.operands, {call.d, call.s, call.particles});
    task.by_derivatives = call.at<T>(call.operands + 1, {call.d, call.s, call.particles});
    if (gathers) task.value = call.at<T>(call.operands + 2, {task.columns, call.particles});
    if (gathers) task.gradients = call.at<T>(call.operands + 3, {call.d, task.columns, call.particles});
    if (!call.fault.empty()) return true;
    return pull(pool, {int(call.d), int(call.s), false}, call.batch, task);
  }
};

struct ResistOf {
  template <class T>
  bool run(const Pool& pool, Call& call) const {
    const int64_t m = call.d * call.d;
    const size_t k = call.factors(false);
    Resist<T> task = {};
    task.stencils = call.stencils<T>(false);
    task.size = call.dim(k + 1, 2);
    task.columns = call.d;
    task.matrices = call.at<T>(k, {m * (m + 1) / 2, call.particles});
    task.moved = call.at<T>(k + 1, {task.size, call.d});
    task.nodes = call.at<T>(k + 2, {task.size, call.d});
    call.expect(call.operands == k + 2 && call.buffers.size() == k + 3, "too many or too few arrays");
    call.expect(task.size > 0 || call.particles == 0, "no nodes to gather from");
    if (!call.fault.empty()) return true;
    return resist(pool, {int(call.d), int(call.s), false}, call.batch, task);
  }
};

struct SolveOf {
  template <class T>
  bool run(const Pool& pool, Call& call) const {
    const size_t k = call.factors(false);
    const int64_t m = call.d * call.d, nodes = call.dim(k + 1, 1), size = nodes * call.d;
    Solve<T> task = {};
    Recurrence<T>& of = task.recurrence;
    of.stencils = call.stencils<T>(false);
    of.nodes = nodes;
    of.columns = call.d;
    of.matrices = call.at<T>(k, {m * (m + 1) / 2, call.particles});
    of.mass = call.at<T>(k + 1, {nodes});
    of.factor = call.at<T>(k + 2, {});
    of.free = call.booleans(k + 3, {size});
    of.weight = call.at<T>(k + 4, {size});
    of.active = call.booleans(k + 5, {(size + kTogether - 1) / kTogether});
    task.start = call.at<T>(k + 6, {size});
    task.rhs = call.at<T>(k + 7, {size});
    task.limits = call.at<T>(k + 8, {kTolerances});
    of.x = call.at<T>(k + 9, {size});
    task.numbers = call.at<T>(k + 10, {kOutcome});
    const int64_t memory = call.leading.empty() ? kVectors * size : 0;
    T* const given = call.at<T>(k + 11, {memory});
    task.memory = memory > 0 ? given : nullptr;
    call.expect(call.operands == k + 9 && call.buffers.size() == k + 12, "too many or too few arrays");
    call.expect(nodes > 0 || call.particles == 0, "no nodes to gather from");
    if (!call.fault.empty()) return true;
    return solve(pool, {int(call.d), int(call.s), false}, call.batch, task);
  }
};

template <class Problem>
ffi::Error run(const Problem& problem, ffi::ThreadPool threads, const ffi::RemainingArgs& arguments,
               const ffi::RemainingRets& results, bool placed = false) {
  Call call = read(placed, arguments, results);
  if (!call.fault.empty()) return wrong(call.fault);
  const XlaPool pool(threads);
  bool known = false;
  if (call.type == ffi::DataType::F32) known = problem.template run<float>(pool, call);
  if (call.type == ffi::DataType::F64) known = problem.template run<double>(pool, call);
  if (!call.fault.empty()) return wrong(call.fault);
  return known ? ffi::Error::Success() : wrong("there is no kernel of this order or type");
}

ffi::Error run_gather(ffi::ThreadPool threads, bool placed, bool differential, ffi::RemainingArgs arguments,
                      ffi::RemainingRets results) {
  return run(GatherOf{differential}, threads, arguments, results, placed);
}

ffi::Error run_scatter(ffi::ThreadPool threads, bool placed, bool differential, bool valued,
                       ffi::RemainingArgs arguments, ffi::RemainingRets results) {
  return run(ScatterOf{differential, valued}, threads, arguments, results, placed);
}

ffi::Error run_average(ffi::ThreadPool threads, bool placed, ffi::RemainingArgs arguments, ffi::RemainingRets results) {
  return run(AverageOf{}, threads, arguments, results, placed);
}

ffi::Error run_pull(ffi::ThreadPool threads, bool valued, ffi::RemainingArgs arguments, ffi::RemainingRets results) {
  return run(PullOf{valued}, threads, arguments, results);
}

ffi::Error run_resist(ffi::ThreadPool threads, bool placed, ffi::RemainingArgs arguments, ffi::RemainingRets results) {
  return run(ResistOf{}, threads, arguments, results, placed);
}

ffi::Error run_solve(ffi::ThreadPool threads, bool placed, ffi::RemainingArgs arguments, ffi::RemainingRets results) {
  return run(SolveOf{}, threads, arguments, results, placed);
}

ffi::Error run_threads(ffi::ThreadPool threads, ffi::ResultBuffer<ffi::DataType::S32> count) {
  *count->typed_data() = static_cast<int32_t>(threads.num_threads());
  return ffi::Error::Success();
}

}  // namespace
}  // namespace mpmjax

#pragma GCC visibility push(default)

XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_gather, mpmjax::run_gather,
                              ffi::Ffi::Bind()
                                  .Ctx<ffi::ThreadPool>()
                                  .Attr<bool>("placed")
                                  .Attr<bool>("differential")
                                  .RemainingArgs()
                                  .RemainingRets());
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_scatter, mpmjax::run_scatter,
                              ffi::Ffi::Bind()
                                  .Ctx<ffi::ThreadPool>()
                                  .Attr<bool>("placed")
                                  .Attr<bool>("differential")
                                  .Attr<bool>("valued")
                                  .RemainingArgs()
                                  .RemainingRets());
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_average, mpmjax::run_average,
                              ffi::Ffi::Bind()
                                  .Ctx<ffi::ThreadPool>()
                                  .Attr<bool>("placed")
                                  .RemainingArgs()
                                  .RemainingRets());
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_pull, mpmjax::run_pull,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Attr<bool>("valued").RemainingArgs().RemainingRets());
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_resist, mpmjax::run_resist,
                              ffi::Ffi::Bind()
                                  .Ctx<ffi::ThreadPool>()
                                  .Attr<bool>("placed")
                                  .RemainingArgs()
                                  .RemainingRets());
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_solve, mpmjax::run_solve,
                              ffi::Ffi::Bind()
                                  .Ctx<ffi::ThreadPool>()
                                  .Attr<bool>("placed")
                                  .RemainingArgs()
                                  .RemainingRets());

// The threads that sums are shared among.
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_threads, mpmjax::run_threads,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Ret<ffi::Buffer<ffi::DataType::S32>>());

// What the package asks of a library before it uses it.
extern "C" int mpmjax_interface() { return MPMJAX_INTERFACE; }
extern "C" const char* mpmjax_instructions() { return mpmjax::instructions(); }

#pragma GCC visibility pop
