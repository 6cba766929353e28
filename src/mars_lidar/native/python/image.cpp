// Bindings of depth from a few photons a pixel; image/solver.h says what each step does.
#include <memory>

#include "image/solver.h"
#include "python/bindings.h"
#include "python/watched.h"

namespace mars {
namespace {

using Floats = Vector<const float>;
using Doubles = Vector<const double>;

// A setting together with the recording into which it points.
struct BoundImageSetting : ImageSetting {
    BoundImageSetting(nb::object given, int count, int64_t first, const Doubles& density, const Doubles& score,
                      double deviation)
        : ImageSetting(*nb::cast<const HistogramRecord*>(given), count, first,
                       {density.data(), density.data() + size_of(density)},
                       {score.data(), score.data() + size_of(score)}, deviation),
          recorded(std::move(given)) {}

    nb::object recorded;
};

// A solver together with the arrays into which it points, and the setting of its last step.
struct BoundImageSolver {
    std::unique_ptr<ImageSolver> solver;
    nb::object arrays;
    nb::object setting = nb::none();
};

template <class Number>
nb::object array_of(std::vector<Number> values, std::initializer_list<size_t> shape) {
    auto* const kept = new std::vector<Number>(std::move(values));
    nb::capsule owner(kept, [](void* p) noexcept { delete static_cast<std::vector<Number>*>(p); });
    return nb::cast(nb::ndarray<nb::numpy, Number>(kept->data(), shape, owner));
}

ImageNetworks* networks_of(const Floats& weights, double factor, double exponent, const Matrix<const double>& limits) {
    const int64_t size = size_of(weights);
    if (size != ImageNetworks::kChoose && size != ImageNetworks::kChoose + ImageNetworks::kWeigh)
        throw nb::value_error("weights must be those of the first network, or of both");
    expect("limits must be (4, 2)", {4, 2}, limits);
    auto out = std::make_unique<ImageNetworks>();
    out->weights.assign(weights.data(), weights.data() + size);
    out->interval_factor = factor;
    out->interval_exponent = exponent;
    std::copy(limits.data(), limits.data() + 8, &out->limits[0][0]);
    return out.release();
}

void make(BoundImageSolver* self, int64_t height, int64_t width, Vector<const int64_t> first, Vector<const int32_t> bin,
          Floats number, Floats counted, Doubles efficiency, int64_t volume_bytes, int64_t block_pixels, int threads) {
    if (height < 1 || width < 1 || size_of(first) != height * width + 1)
        throw nb::value_error("first must be (height * width + 1)");
    if (size_of(bin) != size_of(number) || size_of(bin) != size_of(counted) ||
        first.data()[height * width] != size_of(bin))
        throw nb::value_error("bin, number and counted must have one entry for each of first");
    if (size_of(efficiency) != 0 && size_of(efficiency) != height * width)
        throw nb::value_error("efficiency must be empty or (height * width)");
    new (self) BoundImageSolver;
    self->solver = std::make_unique<ImageSolver>(
        ImagePhotons{height, width, first.data(), bin.data(), number.data(), counted.data()},
        size_of(efficiency) ? efficiency.data() : nullptr, volume_bytes, block_pixels, threads);
    self->arrays = nb::make_tuple(first, bin, number, counted, efficiency);
}

// `settings`: from the widest blur to none.
void solve(BoundImageSolver& self, nb::list settings, const ImageNetworks* networks, Matrix<double> maps,
           Vector<uint8_t> flags) {
    const int64_t pixels = self.solver->pixels();
    expect("maps must be (maps, pixels)", {kImageMaps, pixels}, maps);
    if (size_of(flags) != pixels) throw nb::value_error("flags must be (pixels)");
    std::vector<const ImageSetting*> given;
    for (nb::handle each : settings) given.push_back(nb::cast<const BoundImageSetting*>(each));
    if (given.empty()) throw nb::value_error("settings must be at least one");
    watched(nb::none(),
            [&](const Watch& watch) { self.solver->solve(given, networks, maps.data(), flags.data(), watch); });
}

void begin(BoundImageSolver& self, nb::object setting) {
    const auto* const given = nb::cast<const BoundImageSetting*>(setting);
    self.setting = setting;
    watched(nb::none(), [&](const Watch& watch) { self.solver->begin(*given, watch); });
}

nb::tuple light(const BoundImageSolver& self) {
    const size_t pixels = static_cast<size_t>(self.solver->pixels());
    const ImageLight& of = self.solver->light();
    return nb::make_tuple(array_of(of.signal, {pixels}), array_of(of.background, {pixels}));
}

// Volumes of a whole image, with its size.
struct BoundImageVolumes : ImageVolumes {
    size_t height, width, cells;
};

BoundImageVolumes volumes(const BoundImageSolver& self) {
    const ImagePart whole = self.solver->whole();
    BoundImageVolumes out;
    watched(nb::none(), [&](const Watch& watch) { self.solver->volumes(whole, kImagePeaks, &out, watch); });
    out.height = static_cast<size_t>(whole.y1);
    out.width = static_cast<size_t>(whole.x1);
    out.cells = out.posterior.size() / (out.height * out.width);
    return out;
}

// A view of (H, W, cells) or (pixels, peaks) of volumes.
template <std::vector<float> ImageVolumes::* values, bool in_cells>
nb::object view(nb::handle_t<BoundImageVolumes> self) {
    const auto& of = nb::cast<const BoundImageVolumes&>(self);
    const float* const data = (of.*values).data();
    if constexpr (in_cells)
        return nb::cast(nb::ndarray<nb::numpy, const float>(data, {of.height, of.width, of.cells}, self));
    return nb::cast(nb::ndarray<nb::numpy, const float>(data, {of.height * of.width, kImagePeaks}, self));
}

nb::object candidate_features(const BoundImageSolver& self, const BoundImageVolumes& volumes,
                              Vector<const int64_t> pixel) {
    const std::vector<int64_t> given(pixel.data(), pixel.data() + size_of(pixel));
    const int64_t pixels = self.solver->pixels();
    if (static_cast<int64_t>(volumes.place.size()) != pixels * kImagePeaks)
        throw nb::value_error("volumes must be those of the same image");
    for (const int64_t p : given)
        if (p < 0 || p >= pixels) throw nb::value_error("pixel must lie in the image");
    std::vector<float> out(given.size() * kImagePeaks * kImageCandidateFeatures);
    watched(nb::none(),
            [&](const Watch& watch) { self.solver->candidate_features(volumes, given, out.data(), watch); });
    return array_of(std::move(out), {given.size(), kImagePeaks, kImageCandidateFeatures});
}

nb::tuple choose(BoundImageSolver& self, const ImageNetworks* networks) {
    watched(nb::none(), [&](const Watch& watch) {
        self.solver->choose(networks, watch);
        self.solver->look(watch);
    });
    const size_t pixels = static_cast<size_t>(self.solver->pixels());
    return nb::make_tuple(array_of(self.solver->chosen().delay, {pixels}),
                          array_of(self.solver->chosen().confidence, {pixels}));
}

nb::tuple plane_features(const BoundImageSolver& self) {
    const ImagePart whole = self.solver->whole();
    ImagePlaneFeatures out;
    watched(nb::none(), [&](const Watch& watch) { out = self.solver->plane_features(0, whole.y1, watch); });
    const size_t height = static_cast<size_t>(whole.y1), width = static_cast<size_t>(whole.x1);
    return nb::make_tuple(array_of(std::move(out.features), {kImagePlaneFeatures, height, width}),
                          array_of(std::move(out.delays), {kImageDelays, height, width}),
                          array_of(std::move(out.log_signals), {kImageSignals, height, width}));
}

nb::object weigh(nb::ndarray<const float, nb::ndim<3>, nb::c_contig, nb::device::cpu> features,
                 const ImageNetworks& networks, int threads) {
    if (features.shape(0) != kImagePlaneFeatures) throw nb::value_error("features must be (features, height, width)");
    if (networks.weights.size() <= ImageNetworks::kChoose)
        throw nb::value_error("weights must be those of both networks");
    const size_t height = features.shape(1), width = features.shape(2);
    std::vector<float> out;
    watched(nb::none(), [&](const Watch& watch) {
        out = image_weigh(features.data(), static_cast<int64_t>(height), static_cast<int64_t>(width),
                          networks.weights.data() + ImageNetworks::kChoose, threads, watch);
    });
    return array_of(std::move(out), {kImageOutputs, height, width});
}

}  // namespace

void bind_image(nb::module_& module) {
    nb::class_<BoundImageSetting>(module, "ImageSetting", "Pulse and cells of depth from a few photons a pixel.")
        .def(nb::init<nb::object, int, int64_t, Doubles, Doubles, double>(), "recording"_a, nb::kw_only(), "cells"_a,
             "first"_a, "density"_a, "score"_a, "sigma"_a)
        .def_ro("cells", &BoundImageSetting::cells)
        .def_ro("sigma", &BoundImageSetting::sigma)
        .def_prop_ro("bins", [](const BoundImageSetting& self) { return self.recording->bins; })
        .def_prop_ro(
            "pulse",
            [](const BoundImageSetting& self) {
                const PulseScore& of = self.score;
                return nb::make_tuple(of.low, of.low + static_cast<float>(of.count) / static_cast<float>(of.phases));
            },
            "Begin and end of the pulse about its delay, cells.");

    nb::class_<ImageNetworks>(module, "ImageNetworks", "Weights of both networks, and where they hold.")
        .def(nb::new_(&networks_of), "weights"_a, nb::kw_only(), "interval_factor"_a, "interval_exponent"_a, "limits"_a)
        .def("hold_for", &ImageNetworks::hold_for, nb::kw_only(), "signal"_a, "background"_a, "cells"_a, "side"_a,
             "Whether they hold for mean photons a pixel, cells a period and pixels a side.");

    nb::class_<BoundImageVolumes>(module, "ImageVolumes", "Posterior of each pixel of an image, and its peaks.")
        .def_prop_ro("posterior", &view<&ImageVolumes::posterior, true>, "(H, W, cells).")
        .def_prop_ro("likelihood", &view<&ImageVolumes::likelihood, true>, "(H, W, cells), of mean 1.")
        .def_prop_ro("place", &view<&ImageVolumes::place, false>, "(pixels, peaks), cells.")
        .def_prop_ro("mass", &view<&ImageVolumes::mass, false>, "(pixels, peaks), of the posterior within 2 cells.");

    nb::class_<BoundImageSolver> solver(module, "ImageSolver", "Depth of one image from a few photons a pixel.");
    solver
        .def("__init__", &make, nb::kw_only(), "height"_a, "width"_a, "first"_a, "bin"_a, "number"_a, "counted"_a,
             "efficiency"_a, "volume_bytes"_a, "block_pixels"_a, "threads"_a)
        .def("solve", &solve, "settings"_a, "networks"_a.none(), nb::kw_only(), "maps"_a.noconvert(),
             "flags"_a.noconvert(), "All steps: `maps` (maps, pixels) of native/image/solver.h, and `flags` (pixels).")
        .def("begin", &begin, "setting"_a, "The light, from a first round of delays.")
        .def("light", &light, "Signal and background (pixels), photons of an exposure that is never blind.")
        .def(
            "parts", [](const BoundImageSolver& self) { return self.solver->parts(); }, "Parts of the image.")
        .def("volumes", &volumes, "Posteriors, and the likelihoods that they come from.")
        .def("candidate_features", &candidate_features, "volumes"_a, "pixel"_a,
             "(pixels, peaks, features) that the first network reads of some pixels.")
        .def(
            "background_near",
            [](const BoundImageSolver& self) {
                std::vector<float> out(self.solver->pixels());
                for (size_t p = 0; p < out.size(); ++p) out[p] = self.solver->background_near(static_cast<int64_t>(p));
                const size_t pixels = out.size();
                return array_of(std::move(out), {pixels});
            },
            "Photons of background about the delay (pixels).")
        .def("choose", &choose, "networks"_a.none(), "Delay, in cells, and confidence (pixels) that are chosen.")
        .def("plane_features", &plane_features,
             "(features, H, W) that the second network reads; delays and logarithms of signals that it weighs.");
    module.def("image_weigh", &weigh, "features"_a, "networks"_a, "threads"_a,
               "Outputs (outputs, H, W) of the second network.");

    const ImageOffsets offsets;
    nb::list pixels;
    for (int k = 0; k < kImageOffsets; ++k) pixels.append(nb::make_tuple(offsets.down[k], offsets.right[k]));
    nb::dict sizes;
    sizes["lanes"] = kImageLanes;
    sizes["phases"] = kImagePhases;
    sizes["maps"] = static_cast<int>(kImageMaps);
    sizes["peaks"] = kImagePeaks;
    sizes["hidden"] = kImageHidden;
    sizes["channels"] = kImageChannels;
    sizes["features"] = kImageCandidateFeatures;
    sizes["plane_features"] = kImagePlaneFeatures;
    sizes["delays"] = kImageDelays;
    sizes["signals"] = kImageSignals;
    sizes["outputs"] = kImageOutputs;
    module.attr("IMAGE_SIZES") = sizes;
    module.attr("IMAGE_OFFSETS") = nb::tuple(pixels);
    module.attr("IMAGE_PRIOR") = nb::make_tuple(kImageStepSigma, kImageWide, kImageJump);
    module.attr("IMAGE_SETTLED") = kImageSettled;
    module.attr("IMAGE_OUTLIER_SIGMA") = kImageOutlierSigma;
    module.attr("IMAGE_BRIGHT") = kImageBright;
    module.attr("IMAGE_LEVEL") = kImageLevel;
}

}  // namespace mars
