// The extension module ultragray._cpu. Arrays come in contiguous and typed: nothing is copied or converted silently.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <optional>

#include "render.hpp"

namespace nb = nanobind;
using namespace ultragray;

namespace {

using Vector = nb::ndarray<const float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Matrix = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Poses = nb::ndarray<const double, nb::shape<-1, 4, 4>, nb::c_contig, nb::device::cpu>;
using Planes = nb::ndarray<float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;

}  // namespace

NB_MODULE(_cpu, m) {
    nb::set_leak_warnings(false);  // a scene that a script still holds when it ends is no leak
    nb::class_<PreparedScene>(m, "PreparedScene")
        .def(
            "__init__",
            [](PreparedScene* self, Matrix means, Matrix scales, Matrix quats, Vector transmittances, Vector sh0, Matrix shn,
               int sh_degree, bool sigmoid) {
                const int64_t n = means.shape(0);
                const size_t rest = size_t(sh_degree + 1) * (sh_degree + 1) - 1;
                if (sh_degree < 0 || sh_degree > 3 || means.shape(1) != 3 || scales.shape(0) != size_t(n) ||
                    scales.shape(1) != 3 || quats.shape(0) != size_t(n) || quats.shape(1) != 4 ||
                    transmittances.shape(0) != size_t(n) || sh0.shape(0) != size_t(n) || shn.shape(0) != size_t(n) ||
                    shn.shape(1) != rest)
                    throw std::invalid_argument("the parameters' shapes do not agree");
                const RawSplats raw{means.data(),
                                    scales.data(),
                                    quats.data(),
                                    transmittances.data(),
                                    sh0.data(),
                                    shn.data(),
                                    n,
                                    sh_degree,
                                    sigmoid ? Intensity::Sigmoid : Intensity::Released};
                nb::gil_scoped_release release;
                new (self) PreparedScene(raw);
            },
            nb::arg("means").noconvert(), nb::arg("scales").noconvert(), nb::arg("quats").noconvert(),
            nb::arg("transmittances").noconvert(), nb::arg("sh0").noconvert(), nb::arg("shn").noconvert(),
            nb::arg("sh_degree"), nb::arg("sigmoid"))
        .def_prop_ro("bytes", &PreparedScene::bytes);

    m.def(
        "render",
        [](const PreparedScene& scene, bool convex, double width_cm, double opening_rad, double near_cm, double far_cm,
           double cull_far_cm, Poses poses, int height, int width, int threads, const std::string& instruction_set,
           std::optional<Planes> bmode, std::optional<Planes> echo, std::optional<Planes> transmittance,
           std::optional<Planes> coverage) {
            const size_t count = poses.shape(0);
            const auto plane = [&](std::optional<Planes>& array) -> float* {
                if (!array) return nullptr;
                if (array->shape(0) != count || array->shape(1) != size_t(height) || array->shape(2) != size_t(width))
                    throw std::invalid_argument("an output's shape is not [C, height, width]");
                return array->data();
            };
            const Outputs outputs{plane(bmode), plane(echo), plane(transmittance), plane(coverage)};
            const ProbeGeometry probe{convex, width_cm, opening_rad, near_cm, far_cm, cull_far_cm};
            nb::gil_scoped_release release;
            render(scene, probe, poses.data(), int(count), height, width, threads, instruction_set, outputs);
        },
        nb::arg("scene"), nb::arg("convex"), nb::arg("width_cm"), nb::arg("opening_rad"), nb::arg("near_cm"),
        nb::arg("far_cm"), nb::arg("cull_far_cm"), nb::arg("poses").noconvert(), nb::arg("height"), nb::arg("width"),
        nb::arg("threads"), nb::arg("instruction_set"), nb::arg("bmode").noconvert().none(),
        nb::arg("echo").noconvert().none(), nb::arg("transmittance").noconvert().none(),
        nb::arg("coverage").noconvert().none());

    m.def("instruction_sets", &instruction_sets);
}
