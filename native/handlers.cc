// What XLA calls: each sum as a handler of its foreign function interface. Operands are checked against each other, so
// that nothing is read or written beyond them.
//
//   gather   first, t [, dt], nodes                    ->  a, a_b
//   scatter  first, t [, dt], given ...                ->  nodes
//   average  first, t, least, given ...                ->  whole, means, memory to work in
//   pull     first, t, nodes, given ...                ->  by t [, a, a_b]
//   resist   first, t, matrices, nodes                 ->  nodes
//   solve    first, t, matrices, mass, factor, free, weight, active, x, rhs, limits  ->  x, numbers,
//                                                          memory to work in (of a batch none)
//
// First nodes, offsets t and their changes dt are (..., d, p), values (..., c, p) and gradients (..., d, c, p), nodes
// (..., n, c), matrices (..., d² (d² + 1) / 2, p), with the same leading axes everywhere. Given are a value or gradients or
// both; gradients may have fewer columns than the value. In a solve vectors are (..., n d), mass (..., n), active
// (..., ⌈n d/64⌉). Attributes are the basis, whether there is a value, `valued`, and whether there is dt, `differential`.

#include "call.h"
#include "instructions.h"
#include "solve.h"
#include "sums.h"
#include "vectors.h"

namespace mpmjax {
namespace {

// A sum's call, with the sizes that its stencils have.
Call read(const ffi::RemainingArgs& arguments, const ffi::RemainingRets& results, const ffi::Dictionary& attributes) {
  Call call = collect(arguments, results);
  call.expect(call.operands > 2, "an array is missing");
  if (!call.fault.empty()) return call;
  const Shape shape = shape_of(call.buffers[0]);
  call.expect(shape.size() >= 2 && call.buffers[0].element_type() == ffi::DataType::S32, "no first nodes (..., d, p)");
  if (!call.fault.empty()) return call;
  call.type = call.buffers[1].element_type();
  call.lead(shape, 2);
  call.d = shape[shape.size() - 2];
  call.particles = shape.back();
  call.expect(call.d >= 1 && call.d <= kMostAxes, "no dimension of one to three");
  const auto take = [&](const char* name, auto& to) {
    const auto values = attributes.get<std::decay_t<decltype(to)>>(name);
    call.expect(values.has_value(), "an attribute is missing");
    if (values.has_value()) to = *values;
  };
  take("shape", call.shape), take("periodic", call.periodic);
  take("knots", call.knots), take("weights", call.weights), take("slopes", call.slopes);
  call.s = static_cast<int64_t>(call.knots.size());
  const size_t axes = static_cast<size_t>(call.d), nodes = call.knots.size(), coefficients = call.weights.size();
  call.expect(call.shape.size() == axes && call.periodic.size() == axes, "no number of nodes for each axis");
  call.expect(call.s >= 2 && call.s <= kMostNodes, "there is no kernel of this order");
  call.expect(call.s > 0 && coefficients % nodes == 0 && coefficients <= kMostTerms * nodes &&
                  call.slopes.size() == coefficients,
              "no coefficients (s, terms) of both families");
  for (const int64_t n : call.shape) call.expect(n > 0 && n <= INT32_MAX, "axes without nodes");
  return call;
}

// One problem of each kind from a call; `run` sums it.
struct GatherOf {
  bool differential, valued;

  template <class T>
  void run(const Pool& pool, Call& call) const {
    const size_t k = 2 + differential;
    Gather<T> task = {};
    task.stencils = call.stencils<T>(differential);
    task.size = call.dim(k, 2);
    task.columns = call.dim(k, 1);
    task.nodes = call.at<T>(k, {task.size, task.columns});
    call.expect(call.operands == k + 1 && call.buffers.size() == k + 3, "too many or too few arrays");
    call.expect(task.size > 0 || call.particles == 0, "no nodes to gather from");
    task.value = call.at<T>(k + 1, {task.columns, call.particles});
    task.gradients = call.at<T>(k + 2, {call.d, task.columns, call.particles});
    if (call.fault.empty()) gather(pool, {int(call.d), int(call.s)}, call.batch, task);
  }
};

struct ScatterOf {
  bool differential, valued;

  template <class T>
  void run(const Pool& pool, Call& call) const {
    const size_t k = 2 + differential;
    Scatter<T> task = {};
    task.stencils = call.stencils<T>(differential);
    task.size = call.dim(call.operands, 2);
    task.columns = call.dim(call.operands, 1);
    task.nodes = call.at<T>(call.operands, {task.size, task.columns});
    call.expect(call.buffers.size() == call.operands + 1, "too many or too few results");
    task.values = call.values<T>(k, valued, task.columns);
    if (call.fault.empty()) scatter(pool, {int(call.d), int(call.s)}, call.batch, task);
  }
};

struct AverageOf {
  bool differential, valued;
  template <class T>
  void run(const Pool& pool, Call& call) const {
    const size_t k = 2;
    Average<T> task = {};
    task.stencils = call.stencils<T>(false);
    task.least = call.at<T>(k, {});
    task.size = call.dim(call.operands, 1);
    task.columns = call.dim(k + 1, 2);
    task.values = call.values<T>(k + 1, true, task.columns);
    task.whole = call.at<T>(call.operands, {task.size});
    task.means = call.at<T>(call.operands + 1, {task.size, task.columns - 1});
    task.sums = call.at<T>(call.operands + 2, {task.size, task.columns});
    call.expect(call.buffers.size() == call.operands + 3, "too many or too few results");
    if (call.fault.empty()) average(pool, {int(call.d), int(call.s)}, call.batch, task);
  }
};

struct PullOf {
  bool differential, valued;

  template <class T>
  void run(const Pool& pool, Call& call) const {
    Pull<T> task = {};
    task.stencils = call.stencils<T>(false);
    task.size = call.dim(2, 2);
    task.columns = call.dim(2, 1);
    task.nodes = call.at<T>(2, {task.size, task.columns});
    task.values = call.values<T>(3, valued, task.columns);
    const bool gathers = call.buffers.size() == call.operands + 3;
    call.expect(gathers || call.buffers.size() == call.operands + 1, "too many or too few results");
    call.expect(task.size > 0 || call.particles == 0, "no nodes to gather from");
    task.by_offset = call.at<T>(call.operands, {call.d, call.particles});
    if (gathers) task.value = call.at<T>(call.operands + 1, {task.columns, call.particles});
    if (gathers) task.gradients = call.at<T>(call.operands + 2, {call.d, task.columns, call.particles});
    if (call.fault.empty()) pull(pool, {int(call.d), int(call.s)}, call.batch, task);
  }
};

struct ResistOf {
  bool differential, valued;
  template <class T>
  void run(const Pool& pool, Call& call) const {
    const int64_t m = call.d * call.d;
    const size_t k = 2;
    Resist<T> task = {};
    task.stencils = call.stencils<T>(false);
    task.size = call.dim(k + 1, 2);
    task.columns = call.d;
    task.matrices = call.at<T>(k, {m * (m + 1) / 2, call.particles});
    task.moved = call.at<T>(k + 1, {task.size, call.d});
    task.nodes = call.at<T>(k + 2, {task.size, call.d});
    call.expect(call.operands == k + 2 && call.buffers.size() == k + 3, "too many or too few arrays");
    call.expect(task.size > 0 || call.particles == 0, "no nodes to gather from");
    const Form form = {int(call.d), int(call.s)};
    if (call.fault.empty()) resist(pool, form, call.batch, task, divided(pool, form, call.batch, task));
  }
};

struct SolveOf {
  bool differential, valued;
  template <class T>
  void run(const Pool& pool, Call& call) const {
    const size_t k = 2;
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
    of.active = call.booleans(k + 5, {(size + kChunk - 1) / kChunk});
    task.start = call.at<T>(k + 6, {size});
    task.rhs = call.at<T>(k + 7, {size});
    task.limits = call.at<T>(k + 8, {kTolerances});
    of.x = call.at<T>(k + 9, {size});
    task.numbers = call.at<T>(k + 10, {kOutcome});
    const int64_t memory = call.leading.empty() ? kVectors * size : 0;
    T* const values = call.at<T>(k + 11, {memory});
    task.memory = memory > 0 ? values : nullptr;
    call.expect(call.operands == k + 9 && call.buffers.size() == k + 12, "too many or too few arrays");
    call.expect(nodes > 0 || call.particles == 0, "no nodes to gather from");
    if (call.fault.empty()) solve(pool, {int(call.d), int(call.s)}, call.batch, task);
  }
};

template <class Problem>
ffi::Error run(ffi::ThreadPool threads, ffi::Dictionary attributes, ffi::RemainingArgs arguments,
               ffi::RemainingRets results) {
  Call call = read(arguments, results, attributes);
  if (!call.fault.empty()) return wrong(call.fault);
  const auto is = [&](const char* name) {
    const auto value = attributes.get<bool>(name);
    return value.has_value() && *value;
  };
  const Problem problem = {is("differential"), is("valued")};
  const XlaPool pool(threads);
  if (call.type == ffi::DataType::F32) {
    problem.template run<float>(pool, call);
  } else if (call.type == ffi::DataType::F64) {
    problem.template run<double>(pool, call);
  } else {
    call.expect(false, "there is no kernel of this type");
  }
  return call.fault.empty() ? ffi::Error::Success() : wrong(call.fault);
}

ffi::Error run_threads(ffi::ThreadPool threads, ffi::ResultBuffer<ffi::DataType::S32> count) {
  *count->typed_data() = static_cast<int32_t>(threads.num_threads());
  return ffi::Error::Success();
}

}  // namespace
}  // namespace mpmjax

#pragma GCC visibility push(default)

#define MPMJAX_SUM(name, Problem)                                              \
  XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_##name, mpmjax::run<mpmjax::Problem>,   \
                                ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Attrs().RemainingArgs().RemainingRets());
MPMJAX_SUM(gather, GatherOf)
MPMJAX_SUM(scatter, ScatterOf)
MPMJAX_SUM(average, AverageOf)
MPMJAX_SUM(pull, PullOf)
MPMJAX_SUM(resist, ResistOf)
MPMJAX_SUM(solve, SolveOf)

// The threads that sums are shared among.
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_threads, mpmjax::run_threads,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Ret<ffi::Buffer<ffi::DataType::S32>>());

// What the package asks of a library before it uses it.
extern "C" int mpmjax_interface() { return MPMJAX_INTERFACE; }
extern "C" const char* mpmjax_instructions() { return mpmjax::instructions(); }

#pragma GCC visibility pop
