#include "common/device.h"

#include <pybind11/pybind11.h>

#include "build_info/module.h"

static snh::Part device([](pybind11::module_& m) {
  m.def(
      "cuda_problem", [](int index) { return snh::cuda_problem(index); }, pybind11::arg("device") = -1,
      "Why the CUDA kernels cannot run on a device (-1: the first), one sentence; empty if they can.");
});
