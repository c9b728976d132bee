// A problem read from a call by XLA and run on what a back end has: a pool of threads, or a stream of a GPU.
//
// Operands and results are the arrays that the problem lists, with the same leading axes everywhere. Their shapes set
// its sizes, and are checked against each other, so that nothing is read or written beyond them. The attribute `present`
// says of each operand whether it is there; optional results come in order until the last one that there is. A sum has
// its basis as attributes, a rearrangement `inverse`.

#pragma once

#include <algorithm>
#include <string>
#include <type_traits>
#include <vector>

#include "problems.h"
#include "xla/ffi/api/ffi.h"

// The problems that CPUs and cards solve: calls f(name of the handler, problem).
#define MPMJAX_PROBLEMS(f)                                                                              \
  f(gather, Gather) f(scatter, Scatter) f(average, Average) f(pull, Pull) f(resist, Resist) f(p2g, P2G) \
      f(g2p, G2P) f(eigen, Eigen) f(rotation, Rotation)

namespace ffi = xla::ffi;

namespace mpmjax {
namespace {

template <class X>
constexpr ffi::DataType type_of() {
  if constexpr (std::is_same_v<X, bool>) return ffi::DataType::PRED;
  if constexpr (std::is_same_v<X, int32_t>) return ffi::DataType::S32;
  return std::is_same_v<X, float> ? ffi::DataType::F32 : ffi::DataType::F64;
}

// A call's buffers, operands and then results, with its attributes. The leading axes are those of the first operand
// before the ones that the problem lists.
struct Call {
  std::vector<ffi::AnyBuffer> buffers;
  size_t operands = 0;
  ffi::Dictionary attributes;
  std::vector<int64_t> leading;
  int64_t batch = 1;
  std::string fault;

  Call(const ffi::RemainingArgs& arguments, const ffi::RemainingRets& results, const ffi::Dictionary& attributes)
      : operands(arguments.size()), attributes(attributes) {
    for (size_t i = 0; i < operands; ++i) buffers.push_back(arguments.get<ffi::AnyBuffer>(i).value());
    for (size_t i = 0; i < results.size(); ++i) buffers.push_back(*results.get<ffi::AnyBuffer>(i).value());
  }

  void expect(bool holds, const char* what) {
    if (!holds && fault.empty()) fault = what;
  }

  ffi::Error outcome() const {
    if (fault.empty()) return ffi::Error::Success();
    return ffi::Error::InvalidArgument("mpmjax's native sums: " + fault + ". This is a fault of mpmjax.");
  }

  template <class To>
  void take(const char* name, To& to) {
    const auto value = attributes.get<To>(name);
    expect(value.has_value(), "an attribute is missing");
    if (value.has_value()) to = *value;
  }

  // Points a problem at the buffers, and sets its sizes.
  template <class Problem>
  void read(Problem& problem) {
    const auto mask = attributes.get<ffi::Span<const int64_t>>("present");
    const ffi::Span<const int64_t> present = mask.has_value() ? *mask : ffi::Span<const int64_t>();
    std::vector<const int64_t*> set;
    size_t listed = 0, k = 0;
    problem.arrays([&](auto& array, Lengths lengths, bool optional = false) {
      using Element = std::remove_pointer_t<std::remove_reference_t<decltype(array)>>;
      constexpr bool is_operand = std::is_const_v<Element>;
      const size_t i = listed++;
      const bool there = is_operand ? (i < present.size() ? present[i] != 0 : !optional) : !optional || k < buffers.size();
      expect(there || optional, "an operand is missing");
      if (!there || !fault.empty()) return;
      expect(is_operand ? k < operands : k >= operands && k < buffers.size(), "too many or too few arrays");
      if (!fault.empty()) return;
      const ffi::AnyBuffer& buffer = buffers[k];
      const auto shape = buffer.dimensions();
      if (k == 0 && shape.size() >= lengths.size()) leading.assign(shape.begin(), shape.end() - lengths.size());
      expect(buffer.element_type() == type_of<std::remove_const_t<Element>>(), "arrays of another type or precision");
      bool fits = shape.size() == leading.size() + lengths.size() &&
                  std::equal(leading.begin(), leading.end(), shape.begin());
      for (size_t a = 0; fits && a < lengths.size(); ++a) {
        const Length& n = lengths.begin()[a];
        const int64_t found = shape[leading.size() + a];
        const bool is_set = n.size == nullptr || std::find(set.begin(), set.end(), n.size) != set.end();
        fits = !is_set || found == (n.size == nullptr ? n.value : *n.size);
        if (!is_set) *n.size = found, set.push_back(n.size);
      }
      expect(fits, "arrays whose shapes do not fit each other");
      array = static_cast<Element*>(buffer.untyped_data());
      ++k;
    });
    expect(k == buffers.size(), "too many or too few arrays");
    for (const int64_t n : leading) batch *= n;
  }
};

// How nodes are numbered, and the polynomials.
template <class T>
void take_basis(Call& call, Basis<T>& basis) {
  ffi::Span<const int64_t> shape, periodic;
  ffi::Span<const double> knots, weights, slopes;
  call.take("shape", shape), call.take("periodic", periodic);
  call.take("knots", knots), call.take("weights", weights), call.take("slopes", slopes);
  const size_t d = shape.size(), s = knots.size(), terms = s > 0 ? weights.size() / s : 0;
  call.expect(d >= 1 && d <= kMostAxes && periodic.size() == d, "no number of nodes for each of one to three axes");
  call.expect(s >= 2 && s <= kMostNodes, "there is no kernel of this order");
  call.expect(weights.size() == terms * s && terms <= kMostTerms && slopes.size() == weights.size(),
              "no coefficients (s, terms) of both families");
  for (const int64_t n : shape) call.expect(n > 0 && n <= INT32_MAX, "axes without nodes");
  if (!call.fault.empty()) return;
  basis.d = static_cast<int>(d), basis.s = static_cast<int>(s), basis.terms = static_cast<int>(terms);
  int64_t stride = 1;
  for (size_t a = d; a-- > 0; stride *= shape[a]) {
    basis.shape[a] = static_cast<int32_t>(shape[a]), basis.strides[a] = static_cast<int32_t>(stride);
    basis.periodic[a] = periodic[a] != 0;
  }
  for (size_t i = 0; i < s; ++i) {
    basis.knots[i] = static_cast<T>(knots[i]);
    for (size_t k = 0; k < terms; ++k) {
      basis.weights[i][k] = static_cast<T>(weights[i * terms + k]);
      basis.slopes[i][k] = static_cast<T>(slopes[i * terms + k]);
    }
  }
}

// What a problem has besides arrays.
template <class Problem, class = void>
constexpr bool kHasBasis = false;
template <class Problem>
constexpr bool kHasBasis<Problem, std::void_t<decltype(Problem::stencils)>> = true;

template <class Problem>
void take_attributes(Call& call, Problem& task) {
  if constexpr (kHasBasis<Problem>) take_basis(call, task.stencils.basis);
}
template <class T>
void take_attributes(Call& call, Rearrangement<T>& task) {
  call.take("inverse", task.inverse);
}

// Whether sizes go together, beyond what the shapes that are listed say.
template <class Problem>
bool fits(const Problem&) { return true; }
template <class Problem>
bool has_nodes(const Problem& all) { return all.size > 0 || all.stencils.particles == 0; }
template <class T>
bool fits(const Gather<T>& all) { return has_nodes(all); }
template <class T>
bool fits(const Scatter<T>& all) { return all.values.graded <= all.columns; }
template <class T>
bool fits(const Average<T>& all) { return all.values.graded <= all.columns; }
template <class T>
bool fits(const Pull<T>& all) {
  return has_nodes(all) && all.values.graded <= all.columns && (all.value == nullptr) == (all.gradients == nullptr);
}
template <class T>
bool fits(const Resist<T>& all) { return has_nodes(all) && all.columns == all.stencils.basis.d; }
template <class T>
bool fits(const P2G<T>& all) { return all.columns == all.stencils.basis.d + 1; }
template <class T>
bool fits(const G2P<T>& all) {
  return has_nodes(all) && all.columns == all.stencils.basis.d && (all.F == nullptr) == (all.strained == nullptr);
}
template <class T>
bool fits(const Solve<T>& all) {
  const int64_t numbers = kVectors * all.nodes * all.stencils.basis.d;
  return (all.nodes > 0 || all.stencils.particles == 0) && (all.room == 0 || all.room == numbers);
}
template <class T>
bool fits(const Product<T>& all) { return all.nodes > 0 ? all.size % all.nodes == 0 : all.size == 0; }

// Reads a problem and runs it. One in double is taken where the first array of numbers is.
template <class Problem, class On>
void run_as(const On& on, Call& call) {
  Problem task = {};
  take_attributes(call, task);
  if (call.fault.empty()) call.read(task);
  call.expect(!call.fault.empty() || fits(task), "arrays whose sizes do not go together");
  if (call.fault.empty()) run(on, call.batch, task);
}
template <class InFloats, class InDoubles, class On>
ffi::Error run_call(const On& on, ffi::Dictionary attributes, ffi::RemainingArgs arguments,
                    ffi::RemainingRets results) {
  Call call(arguments, results, attributes);
  const auto is_float = [](const ffi::AnyBuffer& buffer) {
    return buffer.element_type() == ffi::DataType::F32 || buffer.element_type() == ffi::DataType::F64;
  };
  const auto numbers = std::find_if(call.buffers.begin(), call.buffers.end(), is_float);
  const bool doubles = numbers != call.buffers.end() && numbers->element_type() == ffi::DataType::F64;
  doubles ? run_as<InDoubles>(on, call) : run_as<InFloats>(on, call);
  return call.outcome();
}

}  // namespace
}  // namespace mpmjax
