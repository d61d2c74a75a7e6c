// The pybind11 module: what needs no torch. Each part registers itself in its own <part>_bind.cpp.
#include <pybind11/pybind11.h>

#include "build_info/module.h"

namespace py = pybind11;

std::vector<snh::Register>& snh::registrations() {
  static std::vector<Register> list;
  return list;
}

PYBIND11_MODULE(_core, m) {
  m.doc() = "Torch-free native parts of snh: numpy arrays in, numpy arrays out.";
#ifdef SNH_WITH_CUDA
  m.attr("built_with_cuda") = true;
#else
  m.attr("built_with_cuda") = false;
#endif
  for (snh::Register part : snh::registrations()) part(m);
}
