// What the torch faces share about devices. An op is registered for the CPU and for CUDA with one function:
//
//   const DeviceScope scope(kOp, {{"depth", depth}, {"uniforms", uniforms}});
//   ... outputs by new_empty of an input ...
//   if (scope.on_cuda()) {
//     SNH_KERNELS(cuda::op(..., scope.stream());)
//     return ...;
//   }
//
// Built with SNH_HOST_SHIM the same faces become torch.ops.snh_shim: their kernels run on CPU tensors.
#pragma once

#include <torch/csrc/stable/accelerator.h>

#include <initializer_list>
#include <optional>

#include "common/check.h"
#include "common/device.h"
#include "common/stream.h"

// SNH_OPS(m) { m.def(...); }        the schemas of a face
// SNH_OPS_IMPL(m) { m.impl(...); }  its functions, for every device
#ifdef SNH_HOST_SHIM
#define SNH_OPS(m) STABLE_TORCH_LIBRARY_FRAGMENT(snh_shim, m)
#define SNH_OPS_IMPL(m) STABLE_TORCH_LIBRARY_IMPL(snh_shim, CPU, m)
#else
#define SNH_OPS(m) STABLE_TORCH_LIBRARY_FRAGMENT(snh, m)
#define SNH_OPS_IMPL(m)                                                    \
  static void snh_ops_impl(torch::stable::detail::StableLibrary& m);       \
  STABLE_TORCH_LIBRARY_IMPL(snh, CPU, library) { snh_ops_impl(library); }  \
  STABLE_TORCH_LIBRARY_IMPL(snh, CUDA, library) { snh_ops_impl(library); } \
  static void snh_ops_impl(torch::stable::detail::StableLibrary& m)
#endif

#if SNH_HAVE_KERNELS
#define SNH_KERNELS(...) __VA_ARGS__
#else
#define SNH_KERNELS(...)
#endif

// Of libtorch_cuda; null in a CPU build of torch, which never asks for a stream.
extern "C" __attribute__((weak, visibility("default"))) int32_t
aoti_torch_get_current_cuda_stream(int32_t device, void** stream);

namespace snh {

// The device of an op's tensors, made current for the scope; one sentence where they lie on several, where kernels
// cannot run on it, and where a tensor is float64 on CUDA.
class DeviceScope {
 public:
  struct Argument {
    Argument(const char* name, const Tensor& tensor) : name(name), tensor(&tensor) {}
    Argument(const char* name, const std::optional<Tensor>& tensor)
        : name(name), tensor(tensor ? &*tensor : nullptr) {}
    const char* name;
    const Tensor* tensor;  // null: not given
  };

  DeviceScope(const char* op, std::initializer_list<Argument> arguments) {
    const Argument* first = nullptr;
    for (const Argument& argument : arguments) {
      if (!argument.tensor) continue;
      if (!first) first = &argument;
      STD_TORCH_CHECK(place_of(*argument.tensor) == place_of(*first->tensor), "snh::", op, ": argument '",
                      argument.name, "' is on ", place_of(*argument.tensor), " but '", first->name,
                      "' is on ", place_of(*first->tensor), "; move all to one device");
    }
    STD_TORCH_CHECK(first, "snh::", op, ": no tensor was given");
#ifdef SNH_HOST_SHIM
    on_cuda_ = true;
#else
    on_cuda_ = first->tensor->is_cuda();
    if (on_cuda_) enter(op, first->tensor->get_device_index());
#endif
    if (!on_cuda_) return;
    for (const Argument& argument : arguments)
      STD_TORCH_CHECK(!argument.tensor || argument.tensor->scalar_type() != ScalarType::Double, "snh::", op,
                      ": argument '", argument.name, "' must be float32 on CUDA, got Double");
  }

  bool on_cuda() const { return on_cuda_; }
  Stream stream() const { return stream_; }

 private:
  static std::string place_of(const Tensor& t) {
    return t.is_cuda()  ? "cuda:" + std::to_string(t.get_device_index())
           : t.is_cpu() ? "cpu"
                        : "another device";
  }

  void enter(const char* op, int32_t device) {
    const std::string problem = known_usable(device) ? "" : cuda_problem(device);
    STD_TORCH_CHECK(problem.empty(), "snh::", op, ": ", problem);
    known_usable(device) = true;
    guard_.emplace(device);
    SNH_KERNELS(cuda::use_device(device);)
    void* stream = nullptr;
    STABLE_TORCH_ERROR_CODE_CHECK(aoti_torch_get_current_cuda_stream(device, &stream));
    stream_ = static_cast<Stream>(stream);
  }

  static bool& known_usable(int32_t device) {
    static bool known[256] = {};
    return known[device & 255];
  }

  bool on_cuda_ = false;
  std::optional<torch::stable::accelerator::DeviceGuard> guard_;
  Stream stream_ = nullptr;
};

}  // namespace snh
