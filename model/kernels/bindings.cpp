// The extension module ultragray._cpu. Arrays come in contiguous and typed: nothing is copied or converted silently.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <optional>

#include "adam.hpp"
#include "assess.hpp"
#include "between.hpp"
#include "loss.hpp"
#include "pressing.hpp"
#include "render.hpp"
#include "speckle.hpp"
#include "stiffness.hpp"

namespace nb = nanobind;
using namespace ultragray;

namespace {

using Vector = nb::ndarray<const float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Matrix = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Poses = nb::ndarray<const double, nb::shape<-1, 4, 4>, nb::c_contig, nb::device::cpu>;
using FreeVector = nb::ndarray<float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using FreeMatrix = nb::ndarray<float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using ImageBatch = nb::ndarray<const float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using FreeViews = nb::ndarray<double, nb::shape<-1, 2, 3>, nb::c_contig, nb::device::cpu>;
using FreePlanes = nb::ndarray<float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using OptionalPlanes = std::optional<FreePlanes>;
using Flag = nb::ndarray<const int64_t, nb::shape<1>, nb::c_contig, nb::device::cpu>;
using BeamNumbers = std::array<double, 4>;  // of a Beam
using FreeBeam = nb::ndarray<double, nb::shape<3>, nb::c_contig, nb::device::cpu>;
using Cells = nb::ndarray<const int32_t, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Offsets = nb::ndarray<const int32_t, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using GreyImages = nb::ndarray<const uint8_t, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Pairs = nb::ndarray<const int64_t, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using Places = nb::ndarray<const int64_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using PairsOfMaps = nb::ndarray<const float, nb::shape<-1, 2, 3, 3>, nb::c_contig, nb::device::cpu>;
using Floats = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using FreeFloats = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using FreeGrey = nb::ndarray<uint8_t, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Labels = nb::ndarray<const uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using DoubleMatrix = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using FreeDoubleMatrix = nb::ndarray<double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Shafts = nb::ndarray<const double, nb::shape<-1, -1, 2, 3>, nb::c_contig, nb::device::cpu>;
using FreeFields = nb::ndarray<float, nb::ndim<5>, nb::c_contig, nb::device::cpu>;
using FreeMaps = nb::ndarray<double, nb::shape<-1, 3, 4>, nb::c_contig, nb::device::cpu>;
using FreeDoubles = nb::ndarray<double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using FreeCounts = nb::ndarray<int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

// B, E, T, coverage, S and the sum of I*w, each [C, H, W] or null.
Outputs planes_of(const std::array<OptionalPlanes, 6>& arrays, size_t count, int height, int width) {
    std::array<float*, 6> planes{};
    for (size_t k = 0; k < planes.size(); ++k) {
        if (!arrays[k]) continue;
        if (arrays[k]->shape(0) != count || arrays[k]->shape(1) != size_t(height) || arrays[k]->shape(2) != size_t(width))
            throw std::invalid_argument("an output's shape is not [C, height, width]");
        planes[k] = arrays[k]->data();
    }
    return {planes[0], planes[1], planes[2], planes[3], planes[4], planes[5], nullptr, nullptr, 0.0f};
}

using FieldArrays = std::vector<
    std::tuple<nb::ndarray<const float, nb::shape<-1, -1, -1, -1, 3>, nb::c_contig, nb::device::cpu>,
               nb::ndarray<const double, nb::shape<-1, 3, 4>, nb::c_contig, nb::device::cpu>, std::array<double, 3>>>;

// Coefficients [C or 1, X, Y, Z, 3] and maps to the grid [C or 1, 3, 4] of each displacement, and the scene's centre: mm.
Displacements displacements_of(const FieldArrays& arrays, size_t count) {
    Displacements found;
    for (const auto& [coefficients, to_grid, centre_mm] : arrays) {
        const size_t fields = coefficients.shape(0), places = to_grid.shape(0);
        if ((fields != 1 && fields != count) || (places != 1 && places != count))
            throw std::invalid_argument("there must be one displacement, or one for each pose");
        found.push_back({coefficients.data(),
                         to_grid.data(),
                         {int(coefficients.shape(1)), int(coefficients.shape(2)), int(coefficients.shape(3))},
                         fields != 1,
                         places != 1,
                         centre_mm});
    }
    return found;
}

using LineNumbers = std::tuple<bool, bool, float, float, float, float, float, float, float>;  // of FrameLines

FrameLines lines_of(const LineNumbers& numbers, const float* pixels) {
    return std::apply([&](auto... number) { return FrameLines{number..., pixels}; }, numbers);
}

Beam beam_of(const BeamNumbers& numbers) { return {numbers[0], numbers[1], numbers[2], numbers[3]}; }

Limits limits_of(std::optional<int64_t> footprint_pixels, const std::optional<Flag>& flag, int64_t number) {
    Limits limits;
    if (footprint_pixels) limits.footprint_pixels = *footprint_pixels;
    if (flag) limits.flag = flag->data();
    limits.number = number;
    return limits;
}

// The arguments that rendering and recording share.
#define RENDER_ARGUMENTS                                                                                             \
    nb::arg("scene"), nb::arg("fanned"), nb::arg("wrap"), nb::arg("start"), nb::arg("span"), nb::arg("near_cm"),     \
        nb::arg("far_cm"), nb::arg("cull_far_cm"), nb::arg("beam"), nb::arg("poses").noconvert(), nb::arg("height"), \
        nb::arg("width"), nb::arg("threads"), nb::arg("instruction_set"), nb::arg("bmode").noconvert().none(),       \
        nb::arg("echo").noconvert().none(), nb::arg("transmittance").noconvert().none(),                             \
        nb::arg("coverage").noconvert().none(), nb::arg("weight_sum").noconvert().none(),                            \
        nb::arg("intensity_sum").noconvert().none()

}  // namespace

NB_MODULE(_cpu, m) {
    nb::set_leak_warnings(false);  // a scene that a script still holds when it ends is no leak
    nb::exception<GivenUp>(m, "GivenUp");
    static nb::handle too_costly = nb::exception<TooCostly>(m, "TooCostly");  // of two arguments: pose, footprint pixels
    nb::register_exception_translator([](const std::exception_ptr& raised, void*) {
        try {
            std::rethrow_exception(raised);
        } catch (const TooCostly& error) {
            PyErr_SetObject(too_costly.ptr(), nb::make_tuple(error.pose, error.footprint_pixels).ptr());
        }
    });
    nb::class_<PreparedScene>(m, "PreparedScene")
        .def(
            "__init__",
            [](PreparedScene* self, Matrix means, Matrix scales, Matrix quats, Vector transmittances, Vector sh0, Matrix shn,
               int sh_degree, bool sigmoid, bool weighted, bool sorted, int threads) {
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
                                    sigmoid ? Intensity::Sigmoid : Intensity::Released,
                                    weighted};
                nb::gil_scoped_release release;
                new (self) PreparedScene(raw, sorted ? Order::Sorted : Order::AsGiven, threads);
            },
            nb::arg("means").noconvert(), nb::arg("scales").noconvert(), nb::arg("quats").noconvert(),
            nb::arg("transmittances").noconvert(), nb::arg("sh0").noconvert(), nb::arg("shn").noconvert(),
            nb::arg("sh_degree"), nb::arg("sigmoid"), nb::arg("weighted"), nb::arg("sorted"), nb::arg("threads"))
        .def_prop_ro("bytes", &PreparedScene::bytes);

    m.def(
        "render",
        [](const PreparedScene& scene, bool fanned, bool wrap, double start, double span, double near_cm, double far_cm,
           double cull_far_cm, BeamNumbers beam, Poses poses, int height, int width, int threads,
           const std::string& instruction_set, OptionalPlanes bmode, OptionalPlanes echo, OptionalPlanes transmittance,
           OptionalPlanes coverage, OptionalPlanes weight_sum, OptionalPlanes intensity_sum, std::optional<FreeGrey> grey,
           std::optional<FreeCounts> supported, float least_coverage, bool uncut, std::optional<int64_t> footprint_pixels,
           std::optional<Flag> flag, int64_t number, const FieldArrays& displacements) {
            const size_t count = poses.shape(0);
            Outputs outputs =
                planes_of({bmode, echo, transmittance, coverage, weight_sum, intensity_sum}, count, height, width);
            if ((grey && (grey->shape(0) != count || grey->shape(1) != size_t(height) || grey->shape(2) != size_t(width))) ||
                (supported && supported->shape(0) != count))
                throw std::invalid_argument("the shapes of grey frames and counts are not [C, height, width] and [C]");
            outputs.grey = grey ? grey->data() : nullptr;
            outputs.supported = supported ? supported->data() : nullptr;
            outputs.least_coverage = least_coverage;
            const ProbeGeometry probe{fanned, wrap, start, span, near_cm, far_cm, cull_far_cm, beam_of(beam), uncut};
            const Limits limits = limits_of(footprint_pixels, flag, number);
            const Displacements moved = displacements_of(displacements, count);
            nb::gil_scoped_release release;
            render(scene, probe, poses.data(), int(count), height, width, threads, instruction_set, outputs, limits, {},
                   moved);
        },
        RENDER_ARGUMENTS, nb::arg("grey").noconvert().none() = nb::none(),
        nb::arg("supported").noconvert().none() = nb::none(), nb::arg("least_coverage") = 0.0f, nb::arg("uncut") = false,
        nb::arg("footprint_pixels") = nb::none(), nb::arg("flag").noconvert().none() = nb::none(), nb::arg("number") = 0,
        nb::arg("displacements").noconvert() = FieldArrays{});

    m.def(
        "footprints",
        [](const PreparedScene& scene, bool fanned, bool wrap, double start, double span, double near_cm, double far_cm,
           double cull_far_cm, BeamNumbers beam, Poses poses, int height, int width, int threads,
           const std::string& instruction_set, FreeCounts pixels, std::optional<Flag> flag, int64_t number,
           const FieldArrays& displacements) {
            if (pixels.shape(0) != poses.shape(0)) throw std::invalid_argument("there must be one count per pose");
            const ProbeGeometry probe{fanned, wrap, start, span, near_cm, far_cm, cull_far_cm, beam_of(beam)};
            const Limits limits = limits_of({}, flag, number);
            const Displacements moved = displacements_of(displacements, poses.shape(0));
            nb::gil_scoped_release release;
            footprints(scene, probe, poses.data(), int(poses.shape(0)), height, width, threads, instruction_set, limits,
                       pixels.data(), moved);
        },
        nb::arg("scene"), nb::arg("fanned"), nb::arg("wrap"), nb::arg("start"), nb::arg("span"), nb::arg("near_cm"),
        nb::arg("far_cm"), nb::arg("cull_far_cm"), nb::arg("beam"), nb::arg("poses").noconvert(), nb::arg("height"),
        nb::arg("width"), nb::arg("threads"), nb::arg("instruction_set"), nb::arg("pixels").noconvert(),
        nb::arg("flag").noconvert().none() = nb::none(), nb::arg("number") = 0,
        nb::arg("displacements").noconvert() = FieldArrays{});

    m.def(
        "drawing_work",
        [](const PreparedScene& scene, bool fanned, bool wrap, double start, double span, double near_cm, double far_cm,
           double cull_far_cm, BeamNumbers beam, Poses poses, int height, int width, int threads,
           const std::string& instruction_set) {
            const ProbeGeometry probe{fanned, wrap, start, span, near_cm, far_cm, cull_far_cm, beam_of(beam)};
            nb::gil_scoped_release release;
            std::vector<std::array<int64_t, 4>> found;
            for (const Work& one :
                 drawing_work(scene, probe, poses.data(), int(poses.shape(0)), height, width, threads, instruction_set))
                found.push_back({one.slices, one.groups, one.rows, one.lanes});
            return found;
        },
        nb::arg("scene"), nb::arg("fanned"), nb::arg("wrap"), nb::arg("start"), nb::arg("span"), nb::arg("near_cm"),
        nb::arg("far_cm"), nb::arg("cull_far_cm"), nb::arg("beam"), nb::arg("poses").noconvert(), nb::arg("height"),
        nb::arg("width"), nb::arg("threads"), nb::arg("instruction_set"));

    nb::class_<Recording>(m, "Recording")
        .def(
            "__init__",
            [](Recording* self, const PreparedScene& scene, bool fanned, bool wrap, double start, double span,
               double near_cm, double far_cm, double cull_far_cm, BeamNumbers beam, Poses poses, int height, int width,
               int threads, const std::string& instruction_set, OptionalPlanes bmode, OptionalPlanes echo,
               OptionalPlanes transmittance, OptionalPlanes coverage, OptionalPlanes weight_sum,
               OptionalPlanes intensity_sum, const FieldArrays& displacements) {
                const Outputs outputs = planes_of({bmode, echo, transmittance, coverage, weight_sum, intensity_sum},
                                                  poses.shape(0), height, width);
                const ProbeGeometry probe{fanned, wrap, start, span, near_cm, far_cm, cull_far_cm, beam_of(beam)};
                const Displacements moved = displacements_of(displacements, poses.shape(0));
                nb::gil_scoped_release release;
                new (self) Recording(scene, probe, poses.data(), int(poses.shape(0)), height, width, threads,
                                     instruction_set, outputs, moved);
            },
            nb::keep_alive<1, 2>(), RENDER_ARGUMENTS, nb::arg("displacements").noconvert() = FieldArrays{})
        .def(
            "differentiate",
            [](const Recording& self, int threads, OptionalPlanes bmode, OptionalPlanes echo, OptionalPlanes transmittance,
               OptionalPlanes coverage, OptionalPlanes weight_sum, OptionalPlanes intensity_sum, FreeMatrix means,
               FreeMatrix scales, FreeMatrix quats, FreeVector transmittances, FreeVector sh0, FreeMatrix shn,
               std::optional<FreeViews> views, FreeBeam beam, const std::vector<FreeFloats>& displacements) {
                const Outputs gradients = planes_of({bmode, echo, transmittance, coverage, weight_sum, intensity_sum},
                                                    self.count(), self.height(), self.width());
                const size_t n = self.gaussian_count(), rest = self.harmonics() - 1;
                if (means.size() != 3 * n || scales.size() != 3 * n || quats.size() != 4 * n || transmittances.size() != n ||
                    sh0.size() != n || shn.size() != rest * n)
                    throw std::invalid_argument("the gradients' shapes are not those of the parameters");
                if (views && views->shape(0) != size_t(self.count()))
                    throw std::invalid_argument("there must be one gradient per view");
                std::vector<float*> by_displacements;
                for (const FreeFloats& one : displacements) by_displacements.push_back(one.data());
                if (!displacements.empty() && displacements.size() != self.displacements().size())
                    throw std::invalid_argument("there must be one gradient per displacement");
                for (size_t f = 0; f < displacements.size(); ++f) {
                    const Displacement& one = self.displacements()[f];
                    if (displacements[f].size() != size_t(one.floats() * (one.has_many ? self.count() : 1)))
                        throw std::invalid_argument(
                            "the shape of a displacement's gradient is not that of its coefficients");
                }
                static_assert(sizeof(ViewGradient) == 6 * sizeof(double), "a shift and a turn, nothing between");
                ViewGradient* by_views = views ? reinterpret_cast<ViewGradient*>(views->data()) : nullptr;
                const RawGradients out{means.data(),          scales.data(), quats.data(),
                                       transmittances.data(), sh0.data(),    shn.data()};
                nb::gil_scoped_release release;
                const BeamMoments moments = self.differentiate(gradients, out, by_views, by_displacements, threads);
                beam.data()[0] = moments.zeroth, beam.data()[1] = moments.first, beam.data()[2] = moments.second;
            },
            nb::arg("threads"), nb::arg("bmode").noconvert().none(), nb::arg("echo").noconvert().none(),
            nb::arg("transmittance").noconvert().none(), nb::arg("coverage").noconvert().none(),
            nb::arg("weight_sum").noconvert().none(), nb::arg("intensity_sum").noconvert().none(),
            nb::arg("means").noconvert(), nb::arg("scales").noconvert(), nb::arg("quats").noconvert(),
            nb::arg("transmittances").noconvert(), nb::arg("sh0").noconvert(), nb::arg("shn").noconvert(),
            nb::arg("views").noconvert().none(), nb::arg("beam").noconvert(), nb::arg("displacements").noconvert());

    m.def(
        "image_loss",
        [](ImageBatch x, ImageBatch y, FreePlanes gradient, double texture, int threads, const std::string& instruction_set,
           std::optional<ImageBatch> weights) {
            const size_t count = x.shape(0), height = x.shape(1), width = x.shape(2);
            for (size_t d = 0; d < 3; ++d)
                if (y.shape(d) != x.shape(d) || gradient.shape(d) != x.shape(d) ||
                    (weights && (d ? weights->shape(d) != x.shape(d) : weights->shape(d) > count)))
                    throw std::invalid_argument("the images' shapes do not agree");
            if (count == 0 || height < 11 || width < 11) throw std::invalid_argument("images must be at least 11x11 pixels");
            nb::gil_scoped_release release;
            return image_loss(x.data(), y.data(), int(count), int(height), int(width), weights ? weights->data() : nullptr,
                              weights ? int(weights->shape(0)) : 0, texture, threads, instruction_set, gradient.data());
        },
        nb::arg("x").noconvert(), nb::arg("y").noconvert(), nb::arg("gradient").noconvert(), nb::arg("texture"),
        nb::arg("threads"), nb::arg("instruction_set"), nb::arg("weights").noconvert().none() = nb::none());

    m.def(
        "absorption_loss",
        [](ImageBatch transmittance, GreyImages shadowed, Pairs neighbours, double factor, int threads,
           FreePlanes gradient) {
            const size_t count = transmittance.shape(0);
            for (size_t d = 0; d < 3; ++d)
                if (gradient.shape(d) != transmittance.shape(d) || (d && shadowed.shape(d) != transmittance.shape(d)))
                    throw std::invalid_argument("the images' shapes do not agree");
            if (neighbours.shape(0) != count) throw std::invalid_argument("there must be two neighbours per frame");
            for (size_t k = 0; k < 2 * count; ++k)
                if (neighbours.data()[k] < 0 || neighbours.data()[k] >= int64_t(shadowed.shape(0)))
                    throw std::invalid_argument("there is no such frame");
            nb::gil_scoped_release release;
            return absorption_loss(transmittance.data(), shadowed.data(), neighbours.data(), int(count),
                                   int64_t(shadowed.shape(1) * shadowed.shape(2)), factor, threads, gradient.data());
        },
        nb::arg("transmittance").noconvert(), nb::arg("shadowed").noconvert(), nb::arg("neighbours").noconvert(),
        nb::arg("price"), nb::arg("threads"), nb::arg("gradient").noconvert());

    m.def(
        "adam",
        [](const std::vector<FreeFloats>& values, const std::vector<Floats>& gradients, const std::vector<FreeFloats>& first,
           const std::vector<FreeFloats>& second, const std::vector<int64_t>& steps, const std::vector<double>& rates,
           const std::vector<double>& penalties, double beta1, double beta2, double eps, int threads,
           const std::string& instruction_set) {
            std::vector<AdamParameter> parameters;
            for (size_t k = 0; k < values.size(); ++k) {
                for (const size_t size : {gradients.at(k).size(), first.at(k).size(), second.at(k).size()})
                    if (size != values[k].size()) throw std::invalid_argument("sizes of a parameter do not agree");
                parameters.push_back({values[k].data(), gradients[k].data(), first[k].data(), second[k].data(),
                                      int64_t(values[k].size()), steps.at(k), rates.at(k), penalties.at(k)});
            }
            nb::gil_scoped_release release;
            return adam(parameters, beta1, beta2, eps, threads, instruction_set);
        },
        nb::arg("values").noconvert(), nb::arg("gradients").noconvert(), nb::arg("first").noconvert(),
        nb::arg("second").noconvert(), nb::arg("steps"), nb::arg("rates"), nb::arg("penalties"), nb::arg("beta1"),
        nb::arg("beta2"), nb::arg("eps"), nb::arg("threads"), nb::arg("instruction_set"));

    m.def(
        "blend_between",
        [](GreyImages images, Pairs frames, Vector shares, std::optional<PairsOfMaps> onto, std::optional<Matrix> pixels,
           const LineNumbers& lines, int smoothed, float doubtful, float nothing, int threads, FreePlanes blends,
           FreePlanes weights) {
            const size_t count = frames.shape(0), height = images.shape(1), width = images.shape(2);
            if (shares.shape(0) != count || (onto && onto->shape(0) != count) || onto.has_value() != pixels.has_value() ||
                (pixels && (pixels->shape(0) != 2 || pixels->shape(1) != height * width)))
                throw std::invalid_argument("the shapes of frames, shares and maps do not agree");
            for (const FreePlanes& out : {blends, weights})
                if (out.shape(0) != count || out.shape(1) != height || out.shape(2) != width)
                    throw std::invalid_argument("an output's shape is not [V, H, W]");
            for (size_t k = 0; k < 2 * count; ++k)
                if (frames.data()[k] < 0 || frames.data()[k] >= int64_t(images.shape(0)))
                    throw std::invalid_argument("there is no such frame");
            const FrameLines on_frame = lines_of(lines, pixels ? pixels->data() : nullptr);
            nb::gil_scoped_release release;
            blend_between(images.data(), int(height), int(width), frames.data(), int(count), shares.data(),
                          onto ? onto->data() : nullptr, on_frame, {smoothed, doubtful, nothing}, threads, blends.data(),
                          weights.data());
        },
        nb::arg("images").noconvert(), nb::arg("frames").noconvert(), nb::arg("shares").noconvert(),
        nb::arg("onto").noconvert().none(), nb::arg("pixels").noconvert().none(), nb::arg("lines"), nb::arg("smoothed"),
        nb::arg("doubtful"), nb::arg("nothing"), nb::arg("threads"), nb::arg("blends").noconvert(),
        nb::arg("weights").noconvert());

    m.def(
        "interpolate_planes",
        [](GreyImages images, Poses image_poses, Poses poses, Places frames, Matrix pixels, const LineNumbers& lines,
           int threads, FreePlanes planes) {
            const size_t count = poses.shape(0), height = images.shape(1), width = images.shape(2);
            if (image_poses.shape(0) != images.shape(0) || frames.shape(0) != count || pixels.shape(0) != 2 ||
                pixels.shape(1) != height * width || planes.shape(0) != count || planes.shape(1) != height ||
                planes.shape(2) != width)
                throw std::invalid_argument("the shapes of images, poses, frames, pixels and planes do not agree");
            for (size_t k = 0; k < frames.size(); ++k)
                if (frames.data()[k] >= int64_t(images.shape(0))) throw std::invalid_argument("there is no such frame");
            nb::gil_scoped_release release;
            interpolate_planes(images.data(), int(height), int(width), image_poses.data(), poses.data(), frames.data(),
                               int(count), int(frames.shape(1)), lines_of(lines, pixels.data()), threads, planes.data());
        },
        nb::arg("images").noconvert(), nb::arg("image_poses").noconvert(), nb::arg("poses").noconvert(),
        nb::arg("frames").noconvert(), nb::arg("pixels").noconvert(), nb::arg("lines"), nb::arg("threads"),
        nb::arg("planes").noconvert());

    m.def("stiffness_kpa", &stiffness_kpa, nb::arg("label"));

    nb::class_<Press>(m, "Press")
        .def(
            "__init__",
            [](Press* self, Matrix means_mm, std::optional<Labels> labels, Vector compliances, double depth, double breadth,
               bool curved, double far, double half_width, Poses poses) {
                if (means_mm.shape(1) != 3 || (labels && labels->shape(0) != means_mm.shape(0)) ||
                    compliances.shape(0) != 256)
                    throw std::invalid_argument("the shapes of means, labels and compliances do not agree");
                nb::gil_scoped_release release;
                auto compliance = std::make_shared<const Compliance>(means_mm.data(), labels ? labels->data() : nullptr,
                                                                     int64_t(means_mm.shape(0)), compliances.data());
                new (self) Press(std::move(compliance), {depth, breadth, curved, far, half_width}, poses.data(),
                                 int(poses.shape(0)));
            },
            nb::arg("means_mm").noconvert(), nb::arg("labels").noconvert().none(), nb::arg("compliances").noconvert(),
            nb::arg("depth"), nb::arg("breadth"), nb::arg("curved"), nb::arg("far"), nb::arg("half_width"),
            nb::arg("poses").noconvert())
        .def_prop_ro("size", &Press::size)
        .def(
            "at",
            [](const Press& self, Poses poses, DoubleMatrix indentation_mm, Shafts needles_mm, FreeFields coefficients,
               FreeMaps to_grid, FreeDoubles force_n) {
                const size_t count = poses.shape(0);
                if (indentation_mm.shape(0) != count || indentation_mm.shape(1) == 0 || needles_mm.shape(0) != count ||
                    coefficients.shape(0) != count || to_grid.shape(0) != count || force_n.shape(0) != count)
                    throw std::invalid_argument("there must be as many of all as poses");
                const std::array<int, 3> size = self.size();
                for (int d = 0; d < 3; ++d)
                    if (coefficients.shape(1 + d) != size_t(size[d]))
                        throw std::invalid_argument("the field's size is not that of the press");
                nb::gil_scoped_release release;
                for (size_t c = 0; c < count; ++c) {
                    std::vector<Shaft> needles(needles_mm.shape(1));
                    static_assert(sizeof(Shaft) == 6 * sizeof(double), "two points, nothing between");
                    std::copy_n(needles_mm.data() + 6 * needles.size() * c, 6 * needles.size(),
                                reinterpret_cast<double*>(needles.data()));
                    const Pressed pressed =
                        self.at(poses.data() + 16 * c, indentation_mm.data() + indentation_mm.shape(1) * c,
                                int(indentation_mm.shape(1)), needles);
                    std::copy(pressed.coefficients.begin(), pressed.coefficients.end(),
                              coefficients.data() + pressed.coefficients.size() * c);
                    std::copy(pressed.to_grid.begin(), pressed.to_grid.end(), to_grid.data() + 12 * c);
                    force_n.data()[c] = pressed.force_n;
                }
            },
            nb::arg("poses").noconvert(), nb::arg("indentation_mm").noconvert(), nb::arg("needles_mm").noconvert(),
            nb::arg("coefficients").noconvert(), nb::arg("to_grid").noconvert(), nb::arg("force_n").noconvert());

    m.def(
        "add_speckle",
        [](ImageBatch bmode, FreePlanes out, bool alone, Matrix row_weights, ImageBatch column_weights, Matrix plane_weights,
           Vector strength, uint32_t seed, float first_look, float floor, float mean, float scale, int row_step,
           Cells starts, Cells steps, Offsets beside, Matrix plane_phases, ImageBatch column_phases, int threads,
           const std::string& instruction_set) {
            const size_t count = out.shape(0), height = out.shape(1), width = out.shape(2), columns = starts.shape(2);
            const size_t rows = plane_weights.shape(0), taps = row_weights.shape(1), wide = column_weights.shape(2);
            const size_t column_step = column_weights.shape(1);
            for (size_t d = 0; d < 3; ++d)
                if (bmode.shape(d) != out.shape(d) || steps.shape(d) != starts.shape(d))
                    throw std::invalid_argument("the shapes of frames or of places do not agree");
            if (row_weights.shape(0) != height || column_weights.shape(0) != height || plane_weights.shape(1) != 2 ||
                strength.shape(0) != size_t(kSpeckleLevels) || starts.shape(0) != count || starts.shape(1) != 3 ||
                beside.shape(0) != count || plane_phases.shape(0) != count || plane_phases.shape(1) != 2 ||
                column_phases.shape(0) != count || column_phases.shape(1) != 2 || column_phases.shape(2) != columns)
                throw std::invalid_argument("the shapes of the speckle do not agree");
            if (columns % kMaxLanes || taps > size_t(kSpeckleTaps) || wide > size_t(kSpeckleTaps) || row_step < 1 ||
                column_step < 1 || height < 1 || width < 1 || (height - 1) / row_step + taps > rows ||
                (width - 1) / column_step + wide > columns)
                throw std::invalid_argument("the samples of speckle do not reach to the borders of the frame");
            const SpeckleGrid grid{int(height),
                                   int(width),
                                   int(rows),
                                   int(columns),
                                   row_step,
                                   int(column_step),
                                   int(taps),
                                   int(wide),
                                   row_weights.data(),
                                   column_weights.data(),
                                   plane_weights.data(),
                                   strength.data(),
                                   seed,
                                   first_look,
                                   floor,
                                   mean,
                                   scale};
            std::vector<SpeckleView> views;
            for (size_t k = 0; k < count; ++k) {
                const int32_t* off = beside.data() + 3 * k;
                const float* phase = plane_phases.data() + 2 * k;
                views.push_back({starts.data() + 3 * columns * k,
                                 steps.data() + 3 * columns * k,
                                 {uint32_t(off[0]), uint32_t(off[1]), uint32_t(off[2])},
                                 phase[0],
                                 phase[1],
                                 column_phases.data() + 2 * columns * k});
            }
            nb::gil_scoped_release release;
            add_speckle(grid, views.data(), int(count), threads, instruction_set, alone ? nullptr : bmode.data(),
                        out.data());
        },
        nb::arg("bmode").noconvert(), nb::arg("out").noconvert(), nb::arg("alone"), nb::arg("row_weights").noconvert(),
        nb::arg("column_weights").noconvert(), nb::arg("plane_weights").noconvert(), nb::arg("strength").noconvert(),
        nb::arg("seed"), nb::arg("first_look"), nb::arg("floor"), nb::arg("mean"), nb::arg("scale"), nb::arg("row_step"),
        nb::arg("starts").noconvert(), nb::arg("steps").noconvert(), nb::arg("beside").noconvert(),
        nb::arg("plane_phases").noconvert(), nb::arg("column_phases").noconvert(), nb::arg("threads"),
        nb::arg("instruction_set"));

    nb::class_<TrainingViews>(m, "TrainingViews")
        .def(
            "__init__",
            [](TrainingViews* self, Poses poses, bool fanned, float slope, float scale, float across, float half, float by_z,
               float near_mm, float far_mm, const std::string& instruction_set) {
                if (poses.shape(0) == 0) throw std::invalid_argument("there must be a view");
                new (self) TrainingViews(poses.data(), poses.shape(0),
                                         {fanned, slope, scale, across, half, by_z, near_mm, far_mm}, instruction_set);
            },
            nb::arg("poses").noconvert(), nb::arg("fanned"), nb::arg("slope"), nb::arg("scale"), nb::arg("across"),
            nb::arg("half"), nb::arg("by_z"), nb::arg("near_mm"), nb::arg("far_mm"), nb::arg("instruction_set"))
        .def(
            "measure",
            [](const TrainingViews& self, Poses poses, DoubleMatrix points, FreeDoubleMatrix nearest_mm,
               FreeDoubleMatrix distance_mm, FreeDoubleMatrix interpolation_mm, FreeDoubleMatrix angle_deg,
               FreeDoubleMatrix weights, FreeDoubleMatrix around_mm) {
                const size_t count = poses.shape(0), each = points.shape(0);
                if (points.shape(1) != 3 || each == 0) throw std::invalid_argument("points must be [K, 3]");
                const auto put = [&](const FreeDoubleMatrix& into, size_t pose, const std::vector<double>& values) {
                    if (into.shape(0) != count || into.shape(1) != values.size())
                        throw std::invalid_argument("the shapes of poses, points and measures do not agree");
                    std::copy(values.begin(), values.end(), into.data() + pose * values.size());
                };
                for (size_t c = 0; c < count; ++c) {
                    const ViewMeasures found = self.measure(poses.data() + 16 * c, points.data(), each);
                    put(nearest_mm, c, found.nearest_mm), put(distance_mm, c, found.distance_mm);
                    put(interpolation_mm, c, found.interpolation_mm), put(angle_deg, c, found.angle_deg);
                    put(weights, c, found.weights), put(around_mm, c, found.around_mm);
                }
            },
            nb::arg("poses").noconvert(), nb::arg("points").noconvert(), nb::arg("nearest_mm").noconvert(),
            nb::arg("distance_mm").noconvert(), nb::arg("interpolation_mm").noconvert(), nb::arg("angle_deg").noconvert(),
            nb::arg("weights").noconvert(), nb::arg("around_mm").noconvert())
        .def(
            "interpolation_mm",
            [](const TrainingViews& self, Matrix points, FreeDoubles found) {
                if (points.shape(1) != 3 || found.shape(0) != points.shape(0))
                    throw std::invalid_argument("the shapes of points and distances do not agree");
                self.interpolation_mm(points.data(), points.shape(0), found.data());
            },
            nb::arg("points").noconvert(), nb::arg("found").noconvert());

    nb::class_<ConfidenceFormula>(m, "ConfidenceFormula")
        .def(
            "__init__",
            [](ConfidenceFormula* self, std::array<double, 5> weights, double black_ms_ssim, std::vector<double> hardness,
               std::optional<std::array<double, 3>> support, std::optional<double> fitted_to_mm) {
                new (self) ConfidenceFormula{weights, black_ms_ssim, std::move(hardness), {}, fitted_to_mm};
                if (support) self->support = {(*support)[0], (*support)[1], (*support)[2]};
            },
            nb::arg("weights"), nb::arg("black_ms_ssim"), nb::arg("hardness"), nb::arg("support").none(),
            nb::arg("fitted_to_mm").none())
        .def(
            "predict",
            [](const ConfidenceFormula& self, DoubleMatrix distance_mm, DoubleMatrix interpolation_mm,
               DoubleMatrix angle_deg, DoubleMatrix weights) {
                const size_t count = distance_mm.shape(0), each = distance_mm.shape(1), views = self.hardness.size();
                for (const DoubleMatrix* one : {&distance_mm, &interpolation_mm, &angle_deg})
                    if (one->shape(0) != count || one->shape(1) != each)
                        throw std::invalid_argument("the shapes of the measures do not agree");
                if (weights.shape(0) != count || weights.shape(1) != views)
                    throw std::invalid_argument("there must be a weight for each view");
                std::vector<double> found;
                for (size_t c = 0; c < count; ++c)
                    found.push_back(self.predict(distance_mm.data() + c * each, interpolation_mm.data() + c * each,
                                                 angle_deg.data() + c * each, each, weights.data() + c * views));
                return found;
            },
            nb::arg("distance_mm").noconvert(), nb::arg("interpolation_mm").noconvert(), nb::arg("angle_deg").noconvert(),
            nb::arg("weights").noconvert())
        .def("limited", &ConfidenceFormula::limited, nb::arg("confidence"), nb::arg("supported_share"));

    m.def("instruction_sets", &instruction_sets);
}
