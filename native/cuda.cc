// The sums on NVIDIA's cards, without CUDA's headers and compiler: this is built by a C++ compiler alone, and carries the
// text of its kernels. The driver and NVRTC, which JAX brings, are loaded at run time; a kernel is compiled for a basis,
// a type and a card when it is first called, and kept on disk for later processes. Launches are put on XLA's stream and
// can be captured in a graph: but for loading, at the first one, they allocate nothing and wait for nothing.

#include <dlfcn.h>

#include <algorithm>
#include <cstdio>
#include <fstream>
#include <iterator>
#include <map>
#include <mutex>
#include <string>
#include <unistd.h>

#include "calls.h"
#include "launches.h"

// Files as text in this library.
#define MPMJAX_TEXT(name, file)                                                                           \
  asm(".pushsection .rodata\n" #name ": .incbin \"" MPMJAX_FOLDER "/" file "\"\n.byte 0\n.popsection\n"); \
  extern "C" __attribute__((visibility("hidden"))) const char name[];
MPMJAX_TEXT(mpmjax_problems, "problems.h")
MPMJAX_TEXT(mpmjax_numbers, "numbers.h")
MPMJAX_TEXT(mpmjax_step, "step.h")
MPMJAX_TEXT(mpmjax_decompositions, "decompositions.h")
MPMJAX_TEXT(mpmjax_one_thread, "one_thread.h")

namespace mpmjax {
namespace {

// Names of the libraries' types and values.
using Handle = void*;  // a context, stream, module, function or program
constexpr int kMajor = 75, kMinor = 76;  // attributes of a device: its compute capability
constexpr int kRelaxed = 2;              // a mode of capturing streams
constexpr int kThreads = 128;            // of a block
constexpr int64_t kMostMembers = 65535;  // blocks along the second axis of a launch

// What a kernel includes. NVRTC has no standard library.
const char* const kNames[] = {"problems.h", "numbers.h", "step.h", "decompositions.h", "one_thread.h", "cstdint",
                              "initializer_list"};
const char* const kTexts[] = {
    mpmjax_problems, mpmjax_numbers, mpmjax_step, mpmjax_decompositions, mpmjax_one_thread,
    "#pragma once\ntypedef int int32_t; typedef unsigned int uint32_t; typedef long long int64_t;\n", ""};

const char* const kKernel = R"(
extern "C" __global__ void __launch_bounds__(128)
kernel(const __grid_constant__ Problem all, long long count, long long batch) {
  const long long i = blockIdx.x * 128ll + threadIdx.x;
  if (i >= count) return;
  for (long long m = blockIdx.y; m < batch; m += gridDim.y) RUN(mpmjax::member(all, m), i);
}
)";

// A library that is loaded at run time. What it lacks is a null function, which `missing` names.
struct Loaded {
  Handle handle = nullptr;
  std::string missing;

  explicit Loaded(const char* name) : handle(dlopen(name, RTLD_NOW | RTLD_LOCAL)) {
    if (handle == nullptr) missing = dlerror();
  }

  // Becomes a pointer to a function of the type that is asked for.
  struct Symbol {
    Handle address;
    template <class F>
    operator F*() const { return reinterpret_cast<F*>(address); }
  };

  Symbol find(const char* name) {
    const Symbol symbol = {handle == nullptr ? nullptr : dlsym(handle, name)};
    if (symbol.address == nullptr && missing.empty()) missing = std::string("it has no ") + name;
    return symbol;
  }
};

struct Driver : Loaded {
  Driver() : Loaded("libcuda.so.1") {}
  int (*init)(unsigned) = find("cuInit");
  int (*count)(int*) = find("cuDeviceGetCount");
  int (*get_device)(int*, int) = find("cuDeviceGet");
  int (*retain)(Handle*, int) = find("cuDevicePrimaryCtxRetain");
  int (*push)(Handle) = find("cuCtxPushCurrent_v2");
  int (*pop)(Handle*) = find("cuCtxPopCurrent_v2");
  int (*exchange_capture_mode)(int*) = find("cuThreadExchangeStreamCaptureMode");
  int (*context_of)(Handle, Handle*) = find("cuStreamGetCtx");
  int (*current_device)(int*) = find("cuCtxGetDevice");
  int (*attribute)(int*, int, int) = find("cuDeviceGetAttribute");
  int (*load)(Handle*, const void*) = find("cuModuleLoadData");
  int (*function)(Handle*, Handle, const char*) = find("cuModuleGetFunction");
  int (*clear)(unsigned long long, unsigned, size_t, Handle) = find("cuMemsetD32Async");
  int (*launch)(Handle, unsigned, unsigned, unsigned, unsigned, unsigned, unsigned, unsigned, Handle, void**, void**) =
      find("cuLaunchKernel");
  int (*name_error)(int, const char**) = find("cuGetErrorName");

  // Empty for a success.
  std::string fault(int code, const char* what) const {
    if (code == 0) return "";
    const char* name = nullptr;
    name_error(code, &name);
    return std::string(what) + ": " + (name != nullptr ? name : "unknown error");
  }
};

struct Compiler : Loaded {
  explicit Compiler(const char* path) : Loaded(path) {}
  int (*version)(int*, int*) = find("nvrtcVersion");
  int (*create)(Handle*, const char*, const char*, int, const char* const*, const char* const*) =
      find("nvrtcCreateProgram");
  int (*compile)(Handle, int, const char* const*) = find("nvrtcCompileProgram");
  int (*destroy)(Handle*) = find("nvrtcDestroyProgram");
  int (*code_size)(Handle, size_t*) = find("nvrtcGetCUBINSize");
  int (*code)(Handle, char*) = find("nvrtcGetCUBIN");
  int (*log_size)(Handle, size_t*) = find("nvrtcGetProgramLogSize");
  int (*log)(Handle, char*) = find("nvrtcGetProgramLog");
};

const Driver& driver() {
  static const Driver driver;
  return driver;
}

std::mutex mutex;  // of all that follows
Compiler* compiler = nullptr;
std::string folder;  // where compiled kernels are kept; empty for nowhere
std::map<std::pair<Handle, std::string>, Handle> functions;

// 64 bits of FNV-1a.
std::string hash_of(const std::string& text) {
  uint64_t hash = 0xcbf29ce484222325;
  for (const unsigned char c : text) hash = (hash ^ c) * 0x100000001b3;
  char name[17];
  std::snprintf(name, sizeof name, "%016llx", static_cast<unsigned long long>(hash));
  return name;
}

// A kernel's machine code for a card, from the disk or from NVRTC; or what went wrong.
std::string compiled(const std::string& kernel, const std::string& card, std::string& fault) {
  if (compiler == nullptr || !compiler->missing.empty()) return fault = "NVRTC is not loaded", "";
  int major = 0, minor = 0;
  compiler->version(&major, &minor);
  std::string all = kernel;
  for (const char* text : kTexts) all += text;
  const std::string version = std::to_string(major) + "." + std::to_string(minor);
  const std::string path = folder + "/" + hash_of(all + card + version) + ".cubin";
  if (!folder.empty()) {
    std::ifstream kept(path, std::ios::binary);
    const std::string code((std::istreambuf_iterator<char>(kept)), std::istreambuf_iterator<char>());
    if (!code.empty()) return code;
  }
  const std::string target = "--gpu-architecture=" + card;
  const char* const options[] = {target.c_str(), "--std=c++17", "--device-as-default-execution-space"};
  Handle program = nullptr;
  std::string code;
  size_t size = 0;
  compiler->create(&program, kernel.c_str(), "mpmjax.cu", std::size(kTexts), kTexts, kNames);
  if (compiler->compile(program, 3, options) == 0) {
    compiler->code_size(program, &size), code.resize(size), compiler->code(program, &code[0]);
  } else {
    compiler->log_size(program, &size), fault.resize(size), compiler->log(program, &fault[0]);
    fault = "NVRTC " + version + " for " + card + ": " + fault.c_str();
  }
  compiler->destroy(&program);
  if (folder.empty() || code.empty()) return code;
  // Another process sees the whole file or none.
  const std::string begun = path + "." + std::to_string(getpid());
  std::ofstream file(begun, std::ios::binary);
  file.write(code.data(), static_cast<std::streamsize>(code.size()));
  file.close();
  if (!file || std::rename(begun.c_str(), path.c_str()) != 0) std::remove(begun.c_str());
  return code;
}

// The bytes of a problem such as `Gather<float>`.
size_t size_of(const std::string& problem) {
#define MPMJAX_SIZE(name, Problem)                                    \
  if (problem == #Problem "<float>") return sizeof(Problem<float>);   \
  if (problem == #Problem "<double>") return sizeof(Problem<double>);
  MPMJAX_PROBLEMS(MPMJAX_SIZE)
  return 0;
}

// The text of a kernel of a problem, for d, s and columns such as `3, 3, 4`. Both compilers must lay it out alike.
std::string text_of(const std::string& problem, const std::string& dimensions, int terms) {
  return "#define MPMJAX_TERMS " + std::to_string(terms) + "\n#include \"one_thread.h\"\nusing Problem = mpmjax::" +
         problem + ";\nstatic_assert(sizeof(Problem) == " + std::to_string(size_of(problem)) +
         ");\n#define RUN mpmjax::one_thread::run<" + dimensions + ">" + kKernel;
}

// A kernel in a context, which is current: compiled and loaded once.
Handle function_of(Handle context, const std::string& text, std::string& fault) {
  const std::lock_guard<std::mutex> lock(mutex);
  const auto [place, is_new] = functions.try_emplace({context, text}, nullptr);
  if (!is_new && place->second != nullptr) return place->second;
  int device = 0, major = 0, minor = 0;
  driver().current_device(&device);
  driver().attribute(&major, kMajor, device), driver().attribute(&minor, kMinor, device);
  const std::string code = compiled(text, "sm_" + std::to_string(10 * major + minor), fault);
  Handle module = nullptr;
  if (fault.empty()) fault = driver().fault(driver().load(&module, code.data()), "loading a kernel");
  if (fault.empty()) fault = driver().fault(driver().function(&place->second, module, "kernel"), "finding a kernel");
  return place->second;
}

// A context that is current as long as this lives. XLA captures a first call already, and kernels may be loaded while a
// stream is captured in the relaxed mode alone.
struct Entered {
  std::string fault;

  explicit Entered(Handle context) : fault(driver().fault(driver().push(context), "entering a context")) {
    is_entered = fault.empty();
    driver().exchange_capture_mode(&mode);
  }
  Entered(const Entered&) = delete;
  ~Entered() {
    driver().exchange_capture_mode(&mode);
    if (Handle left; is_entered) driver().pop(&left);
  }

 private:
  bool is_entered;
  int mode = kRelaxed;  // and then the mode before
};

// XLA's stream, in its context.
struct Stream {
  Handle handle, context = nullptr;
  mutable std::string fault;
  Entered entered;

  explicit Stream(Handle stream)
      : handle(stream),
        fault(driver().fault(driver().context_of(handle, &context), "finding the context of a stream")),
        entered(context) {
    if (fault.empty()) fault = entered.fault;
  }

  template <class T>
  void clear(T* numbers, int64_t count) const {
    const int64_t words = count * static_cast<int64_t>(sizeof(T) / sizeof(uint32_t));
    if (words == 0 || !fault.empty()) return;
    const auto place = reinterpret_cast<unsigned long long>(numbers);
    fault = driver().fault(driver().clear(place, 0, static_cast<size_t>(words), handle), "clearing nodes");
  }

  template <template <class> class Problem, class T>
  void launch(const char* name, const Problem<T>& all, const Shape& shape, int64_t count, int64_t batch) const {
    if (count == 0 || batch == 0 || !fault.empty()) return;
    const std::string problem = name + std::string(sizeof(T) == sizeof(float) ? "<float>" : "<double>");
    const std::string dimensions =
        std::to_string(shape.d) + ", " + std::to_string(shape.s) + ", " + std::to_string(shape.columns);
    const Handle function = function_of(context, text_of(problem, dimensions, shape.terms), fault);
    if (!fault.empty()) return;
    void* arguments[] = {const_cast<Problem<T>*>(&all), &count, &batch};
    const auto blocks = static_cast<unsigned>((count + kThreads - 1) / kThreads);
    const auto members = static_cast<unsigned>(std::min(batch, kMostMembers));
    const int code = driver().launch(function, blocks, members, 1, kThreads, 1, 1, 0, handle, arguments, nullptr);
    fault = driver().fault(code, name);
  }

  template <class Problem>
  void launch(const char* name, const Problem& all, int64_t count, int64_t batch) const {
    launch(name, all, Shape(), count, batch);
  }
};

template <template <class> class Problem>
ffi::Error run_on_card(Handle stream, ffi::Dictionary attributes, ffi::RemainingArgs arguments,
                       ffi::RemainingRets results) {
  const Stream on(stream);
  const ffi::Error error = run_call<Problem<float>, Problem<double>>(on, attributes, arguments, results);
  return error.success() && !on.fault.empty() ? ffi::Error::Internal("mpmjax's CUDA sums: " + on.fault) : error;
}

// Loads the driver and NVRTC, and compiles and loads a kernel for the first card: why that cannot be done, or nothing.
std::string start(const char* nvrtc, const char* cache) {
  if (!driver().missing.empty()) return "no driver: " + driver().missing;
  int cards = 0, device = 0;
  std::string fault = driver().fault(driver().init(0), "the driver");
  if (fault.empty()) fault = driver().fault(driver().count(&cards), "the driver");
  if (fault.empty() && cards == 0) fault = "the driver has no card";
  if (!fault.empty()) return fault;
  {
    const std::lock_guard<std::mutex> lock(mutex);
    delete compiler;
    compiler = new Compiler(nvrtc), folder = cache;
    if (!compiler->missing.empty()) return "NVRTC: " + compiler->missing;
  }
  // The context that JAX uses too. It is kept, as the kernel in it is.
  Handle context = nullptr;
  driver().get_device(&device, 0);
  fault = driver().fault(driver().retain(&context, device), "the first card");
  if (!fault.empty()) return fault;
  const Entered entered(context);
  if (entered.fault.empty()) function_of(context, text_of("Scatter<float>", "1, 3, 1", 3), fault);
  return entered.fault + fault;
}

}  // namespace
}  // namespace mpmjax

#pragma GCC visibility push(default)

#define MPMJAX_HANDLER(name, Problem)                                                                        \
  XLA_FFI_DEFINE_HANDLER_SYMBOL(                                                                             \
      mpmjax_##name, mpmjax::run_on_card<mpmjax::Problem>,                                                   \
      ffi::Ffi::Bind().Ctx<ffi::PlatformStream<void*>>().Attrs().RemainingArgs().RemainingRets(),            \
      {ffi::Traits::kCmdBufferCompatible});
MPMJAX_PROBLEMS(MPMJAX_HANDLER)

extern "C" int mpmjax_interface() { return MPMJAX_INTERFACE; }

// Why there are no kernels here; empty if there are.
extern "C" const char* mpmjax_start(const char* nvrtc, const char* cache) {
  static std::string reason;
  return (reason = mpmjax::start(nvrtc, cache)).c_str();
}

// Compiles a kernel for a card, such as sm_90, without one: NVRTC's message, empty for none.
extern "C" const char* mpmjax_compile(const char* nvrtc, const char* cache, const char* problem,
                                      const char* dimensions, int terms, const char* card) {
  static std::string fault;
  fault.clear();
  const std::lock_guard<std::mutex> lock(mpmjax::mutex);
  if (mpmjax::compiler == nullptr) mpmjax::compiler = new mpmjax::Compiler(nvrtc);
  mpmjax::folder = cache;
  mpmjax::compiled(mpmjax::text_of(problem, dimensions, terms), card, fault);
  return fault.c_str();
}

#pragma GCC visibility pop
