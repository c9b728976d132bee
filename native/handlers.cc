// What XLA calls: each sum as a handler of its foreign function interface. Operands are checked against each other, so
// that nothing is read or written beyond them.
//
//   gather   index, weights, derivatives [, their changes], nodes      ->  a, a_b for each direction
//   scatter  index, weights, derivatives [, their changes], given ...  ->  nodes
//   pull     index, weights, derivatives, nodes, given ...             ->  by weights, by derivatives
//   resist   index, weights, derivatives, matrices, nodes              ->  nodes
//   combine  a, b, c, d, scales, weight, active                        ->  y, z, sum
//   product  force, v, mass, factor, free, weight, active              ->  image, sum
//   solve    index, weights, derivatives, matrices, mass, factor, free, weight, active, x, rhs, limits  ->  x, numbers
//
// Factors are (..., d, s, p), given and gathered (..., c, p), nodes (..., n, c), matrices (..., d² (d² + 1) / 2, p), with
// the same leading axes everywhere. Vectors are (..., m), scales (..., 2), mass (..., n), active (..., ⌈m/64⌉), and those
// of a solve have m = n d.
// `valued` says whether the first of the given is the value; `differential` whether changes of the factors follow them.

#include <string>
#include <utility>
#include <vector>

#include "solve.h"
#include "sums.h"
#include "targets.h"
#include "vectors.h"
#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;

namespace mpmjax {
namespace {

using Shape = std::vector<int64_t>;

class XlaPool : public Pool {
 public:
  explicit XlaPool(ffi::ThreadPool pool) : pool_(pool), threads_(static_cast<int>(pool.num_threads())) {}
  int threads() const override { return threads_ > 1 ? threads_ : 1; }
  void schedule(std::function<void()> task) const override { pool_.Schedule(std::move(task)); }

 private:
  mutable ffi::ThreadPool pool_;
  int threads_;
};

ffi::Error wrong(const std::string& what) {
  return ffi::Error::InvalidArgument("mpmjax's native sums: " + what + ". This is a fault of mpmjax.");
}

Shape shape_of(const ffi::AnyBuffer& buffer) {
  const auto dims = buffer.dimensions();
  return Shape(dims.begin(), dims.end());
}

// A call's buffers, operands and then results, with what is common to all sums.
struct Call {
  std::vector<ffi::AnyBuffer> buffers;
  size_t operands = 0;
  ffi::DataType type = ffi::DataType::INVALID;
  Shape leading;
  int64_t d = 0, s = 0, particles = 0, batch = 1;
  std::string fault;

  void expect(bool holds, const char* what) {
    if (!holds && fault.empty()) fault = what;
  }

  // The k-th buffer, once it was seen to be of this shape.
  template <class T>
  T* at(size_t k, std::initializer_list<int64_t> trailing) {
    Shape shape = leading;
    shape.insert(shape.end(), trailing);
    expect(k < buffers.size(), "an array is missing");
    if (!fault.empty()) return nullptr;
    expect(buffers[k].element_type() == type, "arrays of different precision");
    expect(shape_of(buffers[k]) == shape, "arrays whose shapes do not fit each other");
    return static_cast<T*>(buffers[k].untyped_data());
  }

  const bool* booleans(size_t k, int64_t count) {
    Shape shape = leading;
    shape.push_back(count);
    expect(k < buffers.size(), "an array is missing");
    if (!fault.empty()) return nullptr;
    expect(buffers[k].element_type() == ffi::DataType::PRED, "no booleans");
    expect(shape_of(buffers[k]) == shape, "arrays whose shapes do not fit each other");
    return static_cast<const bool*>(buffers[k].untyped_data());
  }

  int64_t dim(size_t k, size_t from_behind) {
    if (k >= buffers.size()) return 0;
    const Shape shape = shape_of(buffers[k]);
    return shape.size() >= from_behind ? shape[shape.size() - from_behind] : 0;
  }

  template <class T>
  Stencils<T> stencils(bool differential) {
    Stencils<T> found = {};
    found.index = static_cast<const int32_t*>(buffers[0].untyped_data());
    found.particles = particles;
    found.weights = at<T>(1, {d, s, particles});
    found.derivatives = at<T>(2, {d, s, particles});
    if (differential) {
      found.weight_changes = at<T>(3, {d, s, particles});
      found.derivative_changes = at<T>(4, {d, s, particles});
    }
    return found;
  }

  // What particles give, of the operands from the k-th on.
  template <class T>
  void given(size_t k, bool valued, int64_t columns, const T** to) {
    const size_t count = operands - k;
    expect(operands >= k && (count == size_t(valued) || count == size_t(valued) + d), "too many or too few given");
    for (size_t b = 0; fault.empty() && b < count; ++b) to[b + (valued ? 0 : 1)] = at<T>(k + b, {columns, particles});
  }
};

Call collect(const ffi::RemainingArgs& arguments, const ffi::RemainingRets& results) {
  Call call;
  call.operands = arguments.size();
  for (size_t i = 0; i < arguments.size(); ++i) {
    const auto buffer = arguments.get<ffi::AnyBuffer>(i);
    if (buffer.has_value()) call.buffers.push_back(*buffer);
  }
  for (size_t i = 0; i < results.size(); ++i) {
    auto buffer = results.get<ffi::AnyBuffer>(i);
    if (buffer.has_value()) call.buffers.push_back(**buffer);
  }
  call.expect(call.buffers.size() == arguments.size() + results.size(), "an array is missing");
  return call;
}

// A sum's call, with the sizes that its index and weights have.
Call read(const ffi::RemainingArgs& arguments, const ffi::RemainingRets& results) {
  Call call = collect(arguments, results);
  call.expect(call.operands >= 4, "an array is missing");
  if (!call.fault.empty()) return call;
  const Shape shape = shape_of(call.buffers[0]);
  call.expect(shape.size() >= 3 && call.buffers[0].element_type() == ffi::DataType::S32, "no index (..., d, s, p)");
  if (!call.fault.empty()) return call;
  call.type = call.buffers[1].element_type();
  call.leading.assign(shape.begin(), shape.end() - 3);
  call.d = shape[shape.size() - 3];
  call.s = shape[shape.size() - 2];
  call.particles = shape.back();
  call.expect(call.d >= 1 && call.d <= kMostAxes, "no dimension of one to three");
  for (const int64_t n : call.leading) call.batch *= n;
  return call;
}

// One problem of each kind from a call; `run` sums it.
struct GatherOf {
  bool differential;

  template <class T>
  bool run(const Pool& pool, Call& call) const {
    const size_t k = differential ? 5 : 3;
    Gather<T> task = {};
    task.stencils = call.stencils<T>(differential);
    task.size = call.dim(k, 2);
    task.columns = call.dim(k, 1);
    task.nodes = call.at<T>(k, {task.size, task.columns});
    call.expect(call.operands == k + 1 && call.buffers.size() == k + 2 + call.d, "too many or too few arrays");
    call.expect(task.size > 0 || call.particles == 0, "no nodes to gather from");
    for (int64_t b = 0; b <= call.d; ++b) task.sums[b] = call.at<T>(k + 1 + b, {task.columns, call.particles});
    if (!call.fault.empty()) return true;
    return gather(pool, {int(call.d), int(call.s), differential}, call.batch, task);
  }
};

struct ScatterOf {
  bool differential, valued;

  template <class T>
  bool run(const Pool& pool, Call& call) const {
    const size_t k = differential ? 5 : 3;
    Scatter<T> task = {};
    task.stencils = call.stencils<T>(differential);
    task.size = call.dim(call.operands, 2);
    task.columns = call.dim(call.operands, 1);
    task.nodes = call.at<T>(call.operands, {task.size, task.columns});
    call.expect(call.buffers.size() == call.operands + 1, "too many or too few results");
    call.given<T>(k, valued, task.columns, task.given);
    if (!call.fault.empty()) return true;
    return scatter(pool, {int(call.d), int(call.s), differential}, call.batch, task);
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
    call.given<T>(4, valued, task.columns, task.given);
    call.expect(call.buffers.size() == call.operands + 2, "too many or too few results");
    call.expect(task.size > 0 || call.particles == 0, "no nodes to gather from");
    task.by_weights = call.at<T>(call.operands, {call.d, call.s, call.particles});
    task.by_derivatives = call.at<T>(call.operands + 1, {call.d, call.s, call.particles});
    if (!call.fault.empty()) return true;
    return pull(pool, {int(call.d), int(call.s), false}, call.batch, task);
  }
};

struct ResistOf {
  template <class T>
  bool run(const Pool& pool, Call& call) const {
    const int64_t m = call.d * call.d;
    Resist<T> task = {};
    task.stencils = call.stencils<T>(false);
    task.size = call.dim(4, 2);
    task.columns = call.d;
    task.matrices = call.at<T>(3, {m * (m + 1) / 2, call.particles});
    task.moved = call.at<T>(4, {task.size, call.d});
    task.nodes = call.at<T>(5, {task.size, call.d});
    call.expect(call.operands == 5 && call.buffers.size() == 6, "too many or too few arrays");
    call.expect(task.size > 0 || call.particles == 0, "no nodes to gather from");
    if (!call.fault.empty()) return true;
    return resist(pool, {int(call.d), int(call.s), false}, call.batch, task);
  }
};

struct SolveOf {
  template <class T>
  bool run(const Pool& pool, Call& call) const {
    const int64_t m = call.d * call.d, nodes = call.dim(4, 1), size = nodes * call.d;
    Solve<T> task = {};
    Recurrence<T>& of = task.recurrence;
    of.stencils = call.stencils<T>(false);
    of.nodes = nodes;
    of.columns = call.d;
    of.matrices = call.at<T>(3, {m * (m + 1) / 2, call.particles});
    of.mass = call.at<T>(4, {nodes});
    of.factor = call.at<T>(5, {});
    of.free = call.booleans(6, size);
    of.weight = call.at<T>(7, {size});
    of.active = call.booleans(8, (size + kTogether - 1) / kTogether);
    of.start = call.at<T>(9, {size});
    task.rhs = call.at<T>(10, {size});
    task.limits = call.at<T>(11, {kTolerances});
    of.x = call.at<T>(12, {size});
    task.numbers = call.at<T>(13, {kOutcome});
    call.expect(call.operands == 12 && call.buffers.size() == 14, "too many or too few arrays");
    call.expect(nodes > 0 || call.particles == 0, "no nodes to gather from");
    if (!call.fault.empty()) return true;
    return solve(pool, {int(call.d), int(call.s), false}, call.batch, task);
  }
};

template <class Problem>
ffi::Error run(const Problem& problem, ffi::ThreadPool threads, const ffi::RemainingArgs& arguments,
               const ffi::RemainingRets& results) {
  Call call = read(arguments, results);
  if (!call.fault.empty()) return wrong(call.fault);
  const XlaPool pool(threads);
  bool known = false;
  if (call.type == ffi::DataType::F32) known = problem.template run<float>(pool, call);
  if (call.type == ffi::DataType::F64) known = problem.template run<double>(pool, call);
  if (!call.fault.empty()) return wrong(call.fault);
  return known ? ffi::Error::Success() : wrong("there is no kernel of this order or type");
}

ffi::Error run_gather(ffi::ThreadPool threads, bool differential, ffi::RemainingArgs arguments,
                      ffi::RemainingRets results) {
  return run(GatherOf{differential}, threads, arguments, results);
}

ffi::Error run_scatter(ffi::ThreadPool threads, bool differential, bool valued, ffi::RemainingArgs arguments,
                       ffi::RemainingRets results) {
  return run(ScatterOf{differential, valued}, threads, arguments, results);
}

ffi::Error run_pull(ffi::ThreadPool threads, bool valued, ffi::RemainingArgs arguments, ffi::RemainingRets results) {
  return run(PullOf{valued}, threads, arguments, results);
}

ffi::Error run_resist(ffi::ThreadPool threads, ffi::RemainingArgs arguments, ffi::RemainingRets results) {
  return run(ResistOf{}, threads, arguments, results);
}

ffi::Error run_solve(ffi::ThreadPool threads, ffi::RemainingArgs arguments, ffi::RemainingRets results) {
  return run(SolveOf{}, threads, arguments, results);
}

// Calls on vectors of one size, beside booleans of their blocks, the last operand.
struct Vectors {
  Call call;
  int64_t size = 0;
  const bool* active = nullptr;

  Vectors(const ffi::RemainingArgs& arguments, const ffi::RemainingRets& results, size_t operands, size_t given)
      : call(collect(arguments, results)) {
    call.expect(call.operands == operands && call.buffers.size() == operands + given, "too many or too few arrays");
    if (!call.fault.empty()) return;
    const Shape shape = shape_of(call.buffers[0]);
    call.expect(!shape.empty(), "no vectors");
    if (!call.fault.empty()) return;
    call.type = call.buffers[0].element_type();
    call.leading.assign(shape.begin(), shape.end() - 1);
    for (const int64_t n : call.leading) call.batch *= n;
    size = shape.back();
    active = call.booleans(operands - 1, (size + kTogether - 1) / kTogether);
    call.expect(call.type == ffi::DataType::F32 || call.type == ffi::DataType::F64, "there is no kernel of this type");
  }
};

template <class T>
void combine_call(const Pool& pool, Vectors& vectors) {
  Call& call = vectors.call;
  Combine<T> task = {};
  task.size = vectors.size;
  const T** from[] = {&task.a, &task.b, &task.c, &task.d};
  for (size_t k = 0; k < 4; ++k) *from[k] = call.at<T>(k, {task.size});
  task.scales = call.at<T>(4, {2});
  task.weight = call.at<T>(5, {task.size});
  task.active = vectors.active;
  task.y = call.at<T>(7, {task.size});
  task.z = call.at<T>(8, {task.size});
  task.sum = call.at<T>(9, {});
  if (call.fault.empty()) combine(pool, call.batch, task);
}

template <class T>
void product_call(const Pool& pool, Vectors& vectors) {
  Call& call = vectors.call;
  Product<T> task = {};
  task.size = vectors.size;
  task.nodes = call.dim(2, 1);
  task.force = call.at<T>(0, {task.size});
  task.v = call.at<T>(1, {task.size});
  task.mass = call.at<T>(2, {task.nodes});
  task.factor = call.at<T>(3, {});
  task.free = call.booleans(4, task.size);
  task.weight = call.at<T>(5, {task.size});
  task.active = vectors.active;
  task.image = call.at<T>(7, {task.size});
  task.sum = call.at<T>(8, {});
  call.expect(task.nodes > 0 ? task.size % task.nodes == 0 : task.size == 0, "nodes with unlike numbers of components");
  if (call.fault.empty()) product(pool, call.batch, task);
}

ffi::Error run_combine(ffi::ThreadPool threads, ffi::RemainingArgs arguments, ffi::RemainingRets results) {
  Vectors vectors(arguments, results, 7, 3);
  const XlaPool pool(threads);
  if (!vectors.call.fault.empty()) return wrong(vectors.call.fault);
  vectors.call.type == ffi::DataType::F32 ? combine_call<float>(pool, vectors) : combine_call<double>(pool, vectors);
  return vectors.call.fault.empty() ? ffi::Error::Success() : wrong(vectors.call.fault);
}

ffi::Error run_product(ffi::ThreadPool threads, ffi::RemainingArgs arguments, ffi::RemainingRets results) {
  Vectors vectors(arguments, results, 7, 2);
  const XlaPool pool(threads);
  if (!vectors.call.fault.empty()) return wrong(vectors.call.fault);
  vectors.call.type == ffi::DataType::F32 ? product_call<float>(pool, vectors) : product_call<double>(pool, vectors);
  return vectors.call.fault.empty() ? ffi::Error::Success() : wrong(vectors.call.fault);
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
                                  .Attr<bool>("differential")
                                  .RemainingArgs()
                                  .RemainingRets());
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_scatter, mpmjax::run_scatter,
                              ffi::Ffi::Bind()
                                  .Ctx<ffi::ThreadPool>()
                                  .Attr<bool>("differential")
                                  .Attr<bool>("valued")
                                  .RemainingArgs()
                                  .RemainingRets());
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_pull, mpmjax::run_pull,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Attr<bool>("valued").RemainingArgs().RemainingRets());
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_resist, mpmjax::run_resist,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().RemainingArgs().RemainingRets());
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_combine, mpmjax::run_combine,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().RemainingArgs().RemainingRets());
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_product, mpmjax::run_product,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().RemainingArgs().RemainingRets());
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_solve, mpmjax::run_solve,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().RemainingArgs().RemainingRets());

// The threads that sums are shared among.
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpmjax_threads, mpmjax::run_threads,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Ret<ffi::Buffer<ffi::DataType::S32>>());

// What the package asks of a library before it uses it.
extern "C" int mpmjax_interface() { return MPMJAX_INTERFACE; }
extern "C" const char* mpmjax_instructions() { return mpmjax::instructions(); }

#pragma GCC visibility pop
