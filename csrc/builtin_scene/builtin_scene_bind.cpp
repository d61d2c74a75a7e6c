#include "builtin_scene/builtin_scene.h"

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <cstring>
#include <stdexcept>
#include <thread>

#include "build_info/module.h"

namespace py = pybind11;
using snh::builtin::Mesh;
using snh::builtin::Pinhole;
using snh::builtin::Room;

namespace {

using Doubles = py::array_t<double, py::array::c_style | py::array::forcecast>;

snh::ParallelFor threads(int count) {
  return [count](int64_t n, const std::function<void(int64_t, int64_t)>& body) {
    std::vector<std::thread> workers;
    for (int k = 1; k < count; ++k) workers.emplace_back(body, n * k / count, n * (k + 1) / count);
    body(0, n / count);
    for (std::thread& worker : workers) worker.join();
  };
}

py::tuple render(const Room& room, const Doubles& T_wc, int width, int height, double fx, double fy,
                 double cx, double cy, int n_threads) {
  if (T_wc.ndim() != 2 || T_wc.shape(0) != 4 || T_wc.shape(1) != 4)
    throw std::invalid_argument("BuiltinRoom.render: T_wc must have shape [4, 4]");
  if (width < 1 || height < 1 || n_threads < 1)
    throw std::invalid_argument("BuiltinRoom.render: width, height and n_threads must be positive");
  py::array_t<uint8_t> rgb({height, width, 3});
  py::array_t<float> depth({height, width});
  uint8_t* rgb_data = rgb.mutable_data();
  float* depth_data = depth.mutable_data();
  const double* pose = T_wc.data();
  {
    py::gil_scoped_release unlocked;
    snh::builtin::render(room, {width, height, fx, fy, cx, cy}, pose, rgb_data, depth_data,
                         threads(n_threads));
  }
  return py::make_tuple(rgb, depth);
}

py::tuple mesh(const Room& room, double edge) {
  if (!(edge >= 0.005)) throw std::invalid_argument("BuiltinRoom.mesh: edge must be at least 0.005 m");
  const Mesh made = snh::builtin::make_mesh(room, edge);
  const auto n_vertices = static_cast<py::ssize_t>(made.vertices.size());
  const auto n_faces = static_cast<py::ssize_t>(made.faces.size());
  py::array_t<float> vertices({n_vertices, py::ssize_t(3)});
  py::array_t<int32_t> faces({n_faces, py::ssize_t(3)});
  std::memcpy(vertices.mutable_data(), made.vertices.data(), sizeof(float) * 3 * n_vertices);
  std::memcpy(faces.mutable_data(), made.faces.data(), sizeof(int32_t) * 3 * n_faces);
  return py::make_tuple(vertices, faces);
}

py::array_t<double> signed_distance(const Room& room, const Doubles& points) {
  if (points.ndim() != 2 || points.shape(1) != 3)
    throw std::invalid_argument("BuiltinRoom.signed_distance: points must have shape [N, 3]");
  py::array_t<double> distance(points.shape(0));
  for (py::ssize_t i = 0; i < points.shape(0); ++i)
    distance.mutable_at(i) = room.distance({points.at(i, 0), points.at(i, 1), points.at(i, 2)});
  return distance;
}

const snh::Part part([](py::module_& m) {
  py::class_<Room>(m, "BuiltinRoom",
                   "A furnished room defined in code; see csrc/builtin_scene/builtin_scene.h.")
      .def(py::init(&snh::builtin::make_room), py::arg("number"))
      .def_property_readonly("bounds",
                             [](const Room& room) {
                               py::array_t<double> bounds({2, 3});
                               for (int k = 0; k < 3; ++k)
                                 bounds.mutable_at(0, k) = room.low[k],
                                                      bounds.mutable_at(1, k) = room.high[k];
                               return bounds;
                             })
      .def("render", &render, py::arg("T_wc"), py::arg("width"), py::arg("height"), py::arg("fx"),
           py::arg("fy"), py::arg("cx"), py::arg("cy"), py::arg("n_threads") = 1)
      .def("mesh", &mesh, py::arg("edge") = 0.05)
      .def("signed_distance", &signed_distance, py::arg("points"));
});

}  // namespace
