// The sums that XLA calls, read from its buffers and run on what a back end has: a pool of threads, or a stream of a GPU.
//
// Operands and results are the arrays that a problem lists, with the same leading axes everywhere. Particles give a
// value or gradients or both, and gradients may have fewer columns than the value. A pull returns the gather or not; an
// average returns memory that it worked in. Attributes of a sum are the basis, whether there is a value, `valued`, and
// whether there is dt, `differential`.

#pragma once

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

template <class T, class On = Pool>
void call_gather(const On& on, Call& call) {
  const bool moved = call.flag("differential");
  auto task = sum_of<Gather<T>>(call, 2 + moved);
  if (call.read(task, 3 + moved, 2, {true, true, moved})) gather(on, call.batch, task);
}

template <class T, class On = Pool>
void call_scatter(const On& on, Call& call) {
  const bool moved = call.flag("differential"), valued = call.flag("valued");
  auto task = sum_of<Scatter<T>>(call, call.operands);
  const bool graded = take_graded(call, task, 2 + moved, valued);
  const size_t operands = 2 + moved + valued + graded;
  if (call.read(task, operands, 1, {true, true, moved, valued, graded})) scatter(on, call.batch, task);
}

template <class T, class On = Pool>
void call_average(const On& on, Call& call) {
  auto task = sum_of<Average<T>>(call, call.operands + 2);
  const bool graded = take_graded(call, task, 3, true);
  if (call.read(task, 4 + graded, 3, {true, true, false, true, true, graded})) average(on, call.batch, task);
}

template <class T, class On = Pool>
void call_pull(const On& on, Call& call) {
  const bool valued = call.flag("valued"), gathers = call.buffers.size() > call.operands + 1;
  auto task = sum_of<Pull<T>>(call, 2);
  const bool graded = take_graded(call, task, 3, valued);
  const size_t operands = 3 + valued + graded, results = gathers ? 3 : 1;
  if (call.read(task, operands, results, {true, true, false, true, valued, graded})) pull(on, call.batch, task);
}

template <class T, class On = Pool>
void call_resist(const On& on, Call& call) {
  auto task = sum_of<Resist<T>>(call, 3);
  call.expect(task.columns == task.stencils.basis.d, "a displacement of another dimension");
  if (call.read(task, 4, 1, {true, true, false})) resist(on, call.batch, task);
}

// Runs what is for floats or for doubles, as the operand `like` says. The first operand has so many trailing axes.
template <auto for_floats, auto for_doubles, size_t trailing, size_t like, class On>
ffi::Error run_on(const On& on, ffi::Dictionary attributes, ffi::RemainingArgs arguments, ffi::RemainingRets results) {
  Call call(arguments, results, attributes, trailing);
  if (!call.fault.empty()) return call.outcome();
  const ffi::DataType type = like < call.buffers.size() ? call.buffers[like].element_type() : ffi::DataType::INVALID;
  if (type == ffi::DataType::F32 || for_floats == for_doubles) {
    for_floats(on, call);
  } else if (type == ffi::DataType::F64) {
    for_doubles(on, call);
  } else {
    call.expect(false, "there is no kernel of this type");
  }
  return call.outcome();
}

}  // namespace
}  // namespace mpmjax
