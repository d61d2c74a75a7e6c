// How a <part>_bind.cpp joins the one pybind11 module:
//   static snh::Part part([](pybind11::module_& m) { m.def("name", ...); });
#pragma once

#include <pybind11/pybind11.h>

#include <vector>

namespace snh {

using Register = void (*)(pybind11::module_&);
std::vector<Register>& registrations();

struct Part {
  explicit Part(Register part) { registrations().push_back(part); }
};

}  // namespace snh
