// A call by XLA: its buffers, checked against each other, so that nothing is read or written beyond them, and its
// threads.

#pragma once

#include <string>
#include <utility>
#include <vector>

#include "kernels.h"
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

inline Shape shape_of(const ffi::AnyBuffer& buffer) {
  const auto dims = buffer.dimensions();
  return Shape(dims.begin(), dims.end());
}

template <class X>
constexpr ffi::DataType type_of() {
  if constexpr (std::is_same_v<X, bool>) return ffi::DataType::PRED;
  if constexpr (std::is_same_v<X, int32_t>) return ffi::DataType::S32;
  return std::is_same_v<X, float> ? ffi::DataType::F32 : ffi::DataType::F64;
}

// A call's buffers, operands and then results, with its attributes. The leading axes of a batch are those of the first
// operand before the last few.
struct Call {
  std::vector<ffi::AnyBuffer> buffers;
  size_t operands = 0;
  ffi::Dictionary attributes;
  Shape leading;
  int64_t batch = 1;
  std::string fault;

  Call(const ffi::RemainingArgs& arguments, const ffi::RemainingRets& results, const ffi::Dictionary& attributes,
       size_t trailing)
      : operands(arguments.size()), attributes(attributes) {
    for (size_t i = 0; i < operands; ++i) {
      const auto buffer = arguments.get<ffi::AnyBuffer>(i);
      if (buffer.has_value()) buffers.push_back(*buffer);
    }
    for (size_t i = 0; i < results.size(); ++i) {
      auto buffer = results.get<ffi::AnyBuffer>(i);
      if (buffer.has_value()) buffers.push_back(**buffer);
    }
    expect(buffers.size() == operands + results.size(), "an array is missing");
    if (!fault.empty() || buffers.empty()) return;
    const Shape shape = shape_of(buffers[0]);
    expect(shape.size() >= trailing, "too few axes");
    if (!fault.empty()) return;
    leading.assign(shape.begin(), shape.end() - static_cast<int64_t>(trailing));
    for (const int64_t n : leading) batch *= n;
  }

  void expect(bool holds, const char* what) {
    if (!holds && fault.empty()) fault = what;
  }

  ffi::Error outcome() const {
    if (fault.empty()) return ffi::Error::Success();
    return ffi::Error::InvalidArgument("mpmjax's native sums: " + fault + ". This is a fault of mpmjax.");
  }

  // The length of an array's axis.
  int64_t dim(size_t k, size_t from_behind) const {
    if (k >= buffers.size()) return 0;
    const Shape shape = shape_of(buffers[k]);
    return shape.size() >= from_behind ? shape[shape.size() - from_behind] : 0;
  }

  bool flag(const char* name) const {
    const auto value = attributes.get<bool>(name);
    return value.has_value() && *value;
  }

  template <class To>
  void take(const char* name, To& to) {
    const auto value = attributes.get<To>(name);
    expect(value.has_value(), "an attribute is missing");
    if (value.has_value()) to = *value;
  }

  // Points a problem, whose sizes are set, at so many operands and results. Of the first arrays that it lists,
  // `present` says which there are; those after the last result stay null. Returns whether the call has no fault.
  template <class Problem>
  bool read(Problem& problem, size_t from, size_t to, std::initializer_list<bool> present = {}) {
    size_t i = 0, k = 0;
    problem.arrays([&](auto& array, std::initializer_list<int64_t> trailing) {
      using X = std::remove_const_t<std::remove_pointer_t<std::remove_reference_t<decltype(array)>>>;
      const bool there = i >= present.size() || present.begin()[i];
      if (++i; !there || !fault.empty() || k == buffers.size()) return;
      Shape shape = leading;
      shape.insert(shape.end(), trailing);
      expect(buffers[k].element_type() == type_of<X>(), "arrays of another type or precision");
      expect(shape_of(buffers[k]) == shape, "arrays whose shapes do not fit each other");
      array = static_cast<X*>(buffers[k++].untyped_data());
    });
    expect(operands == from && buffers.size() == from + to, "too many or too few arrays");
    return fault.empty();
  }
};

}  // namespace
}  // namespace mpmjax
