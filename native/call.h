// A call by XLA: its buffers, checked against each other, and its threads.

#pragma once

#include <string>
#include <utility>
#include <vector>

#include "problems.h"
#include "share.h"
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

inline ffi::Error wrong(const std::string& what) {
  return ffi::Error::InvalidArgument("mpmjax's native sums: " + what + ". This is a fault of mpmjax.");
}

inline Shape shape_of(const ffi::AnyBuffer& buffer) {
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
  // The basis: nodes along each axis, (d), whether it is periodic, and knots, (s), and coefficients, (s, terms).
  ffi::Span<const int64_t> shape, periodic;
  ffi::Span<const double> knots, weights, slopes;
  std::string fault;

  void expect(bool holds, const char* what) {
    if (!holds && fault.empty()) fault = what;
  }

  // Takes all axes of a shape but the last few as leading ones.
  void lead(const Shape& shape, size_t trailing) {
    leading.assign(shape.begin(), shape.end() - static_cast<int64_t>(trailing));
    for (const int64_t n : leading) batch *= n;
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

  // The same of booleans.
  const bool* booleans(size_t k, std::initializer_list<int64_t> trailing) {
    Shape shape = leading;
    shape.insert(shape.end(), trailing);
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

  // The stencils: first nodes, offsets, and with `differential` what these change by.
  template <class T>
  Stencils<T> stencils(bool differential) {
    Stencils<T> result = {};
    if (!fault.empty()) return result;
    result.first = static_cast<const int32_t*>(buffers[0].untyped_data());
    result.offset = at<T>(1, {d, particles});
    if (differential) result.change = at<T>(2, {d, particles});
    result.particles = particles;
    Basis<T>& basis = result.basis;
    for (int64_t a = d - 1, stride = 1; a >= 0; stride *= shape[a--]) {
      basis.shape[a] = static_cast<int32_t>(shape[a]), basis.strides[a] = static_cast<int32_t>(stride);
      basis.periodic[a] = periodic[a] != 0;
    }
    const int64_t terms = static_cast<int64_t>(weights.size()) / s;
    basis.terms = static_cast<int>(terms);
    for (int64_t i = 0; i < s; ++i) {
      basis.knots[i] = static_cast<T>(knots[i]);
      for (int64_t k = 0; k < terms; ++k) {
        basis.weights[i][k] = static_cast<T>(weights[i * terms + k]);
        basis.slopes[i][k] = static_cast<T>(slopes[i * terms + k]);
      }
    }
    return result;
  }

  // What particles give, of the operands from the k-th on.
  template <class T>
  ParticleValues<T> values(size_t k, bool valued, int64_t columns) {
    ParticleValues<T> result = {};
    expect(operands >= k && (operands == k + valued || operands == k + valued + 1), "too many or too few given");
    if (fault.empty() && valued) result.value = at<T>(k, {columns, particles});
    if (fault.empty() && operands == k + valued + 1) {
      result.graded = dim(k + valued, 2);
      expect(result.graded <= columns, "more columns of gradients than of nodes");
      result.gradients = at<T>(k + valued, {d, result.graded, particles});
    }
    return result;
  }
};

inline Call collect(const ffi::RemainingArgs& arguments, const ffi::RemainingRets& results) {
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

}  // namespace
}  // namespace mpmjax
