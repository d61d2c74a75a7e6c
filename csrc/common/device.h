// Whether the kernels of this build can run, asked without a CUDA header and without torch.
#pragma once

#include <string>

namespace snh {

#if defined(SNH_WITH_CUDA) || defined(SNH_HOST_SHIM)
#define SNH_HAVE_KERNELS 1
#else
#define SNH_HAVE_KERNELS 0
#endif

namespace cuda {
// Why no kernel can run on a device, one sentence without its full stop; empty if they can. -1: the first device.
std::string device_problem(int device);
// Makes a device the current one of the CUDA runtime that is linked into this library; torch has its own.
void use_device(int device);
}  // namespace cuda

inline std::string cuda_problem(int device) {
#if SNH_HAVE_KERNELS
  return cuda::device_problem(device);
#else
  static_cast<void>(device);
  return "this build of snh-slam has no CUDA kernels; build it where nvcc is found with "
         "SNH_CUDA=on pip install --no-build-isolation ., or use the CPU";
#endif
}

}  // namespace snh
