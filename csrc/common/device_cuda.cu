#include "common/device.h"
#include "common/launch.cuh"

namespace snh::cuda {

#ifdef SNH_HOST_SHIM

std::string device_problem(int) { return {}; }
void use_device(int) {}

#else
namespace {

__global__ void nothing_kernel() {}

std::string version_name(int version) {
  return std::to_string(version / 1000) + "." + std::to_string(version % 1000 / 10);
}

}  // namespace

std::string device_problem(int device) {
  int driver = 0, runtime = 0, n_devices = 0;
  cudaDriverGetVersion(&driver);
  cudaRuntimeGetVersion(&runtime);
  if (driver == 0)
    return "no NVIDIA driver was found; install one for CUDA " + version_name(runtime) +
           " or newer, or use the CPU";
  if (driver / 1000 < runtime / 1000)
    return "the NVIDIA driver knows CUDA " + version_name(driver) + " but the kernels were built with CUDA " +
           version_name(runtime) + "; update the driver, build with an older nvcc, or use the CPU";
  if (cudaGetDeviceCount(&n_devices) != cudaSuccess || n_devices == 0)
    return "no CUDA device was found; use the CPU";
  if (device < 0) device = 0;
  if (device >= n_devices)
    return "there is no CUDA device " + std::to_string(device) + " among the " + std::to_string(n_devices) +
           " found; name another or use the CPU";
  use_device(device);
  cudaFuncAttributes attributes;
  const cudaError_t error = cudaFuncGetAttributes(&attributes, nothing_kernel);
  cudaGetLastError();  // not the next launch's
  if (error == cudaSuccess) return {};
  int major = 0, minor = 0;
  cudaDeviceGetAttribute(&major, cudaDevAttrComputeCapabilityMajor, device);
  cudaDeviceGetAttribute(&minor, cudaDevAttrComputeCapabilityMinor, device);
  const std::string architecture = std::to_string(major) + std::to_string(minor);
  return "this build of snh-slam has no kernels for compute capability " + std::to_string(major) + "." +
         std::to_string(minor) + "; build it with SNH_CUDA_ARCHITECTURES=" + architecture +
         ", or use the CPU";
}

void use_device(int device) { check_cuda(cudaSetDevice(device), "cudaSetDevice"); }

#endif

}  // namespace snh::cuda
