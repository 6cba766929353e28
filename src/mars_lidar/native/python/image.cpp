// Bindings of the stages of depth from a few photons a pixel; image/engine.h says what each does.
#include "image/engine.h"

#include "python/bindings.h"
#include "python/watched.h"

namespace mars {
namespace {

using Image = nb::ndarray<float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Floats = Vector<const float>;

// A setting together with the arrays into which it points.
struct BoundImageSetting : ImageSetting {
    nb::object arrays;
};

BoundImageSetting setting_of(nb::handle recording, int cells, int phases, int pulse_first, Matrix<const float> table,
                             float low, Floats density, Floats score, float near_low, float near_high, float least) {
    if (cells < 16 || cells % 16 != 0) throw nb::value_error("cells must be a multiple of 16");
    if (static_cast<int>(table.shape(0)) != phases || static_cast<int>(table.shape(1)) > cells)
        throw nb::value_error("table must be (phases, at most cells)");
    if (size_of(density) != size_of(score)) throw nb::value_error("density and score must be of one length");
    BoundImageSetting out;
    out.recording = nb::cast<const HistogramRecord*>(recording);
    out.cells = cells;
    float top = 0.0f;
    for (size_t k = 0; k < table.size(); ++k) top = std::max(top, table.data()[k]);
    out.pulse = {phases, pulse_first, static_cast<int>(table.shape(1)), top, table.data()};
    out.score = {phases, size_of(density), low, density.data(), score.data(), near_low, near_high};
    out.least = least;
    out.arrays = nb::make_tuple(recording, table, density, score);
    return out;
}

ImagePhotons photons_of(int64_t height, int64_t width, const Vector<const int64_t>& first,
                        const Vector<const int32_t>& bin, const Floats& number) {
    if (size_of(first) != height * width + 1) throw nb::value_error("first must be (height * width + 1)");
    if (size_of(bin) != size_of(number) || first.data()[height * width] != size_of(bin))
        throw nb::value_error("bin and number must have one entry for each of first");
    return {height, width, first.data(), bin.data(), number.data()};
}

void likelihood(const BoundImageSetting& setting, int64_t height, int64_t width, Vector<const int64_t> first,
                Vector<const int32_t> bin, Floats number, Floats ratio, int64_t y0, int64_t x0, Image out,
                int threads) {
    const ImagePhotons photons = photons_of(height, width, first, bin, number);
    const ImagePart part{y0, y0 + static_cast<int64_t>(out.shape(0)), x0, x0 + static_cast<int64_t>(out.shape(1))};
    if (y0 < 0 || x0 < 0 || part.y1 > height || part.x1 > width || size_of(ratio) != height * width ||
        static_cast<int>(out.shape(2)) != setting.cells)
        throw nb::value_error("out must be (rows, columns, cells) of the image, ratio (height * width)");
    watched(nb::none(), [&](const Watch& watch) {
        image_likelihood(setting, photons, part, ratio.data(), out.data(), threads, watch);
    });
}

void posterior(Image likelihood, Image one, Image other, nb::tuple narrow, float wide, float jump, Matrix<float> place,
               Matrix<float> mass, bool broad, int threads) {
    const int64_t height = static_cast<int64_t>(likelihood.shape(0)), width = static_cast<int64_t>(likelihood.shape(1)),
                  cells = static_cast<int64_t>(likelihood.shape(2)), peaks = static_cast<int64_t>(place.shape(1));
    expect("one and other must be of the likelihood's shape", {height, width, cells}, one, other);
    expect("place and mass must be (pixels, peaks)", {height * width, peaks}, place, mass);
    if (cells % 16 != 0) throw nb::value_error("cells must be a multiple of 16");
    ImageLine step{};
    for (int k = 0; k < 4; ++k) step.narrow[k] = nb::cast<float>(narrow[k]);
    step.wide = wide;
    step.jump = jump;
    watched(nb::none(), [&](const Watch& watch) {
        image_posterior(likelihood.data(), one.data(), other.data(), height, width, static_cast<int>(cells), step,
                        static_cast<int>(peaks), place.data(), mass.data(), broad, threads, watch);
    });
}

ImageCandidates candidates_of(const Image& posterior, const Image& broad, const Image& likelihood,
                              const Matrix<const float>& place, const Matrix<const float>& mass, const Floats& signal,
                              const Vector<const int64_t>& pixel, const Vector<const int32_t>& down,
                              const Vector<const int32_t>& right) {
    ImageCandidates task{};
    task.height = static_cast<int64_t>(posterior.shape(0));
    task.width = static_cast<int64_t>(posterior.shape(1));
    const int64_t cells = static_cast<int64_t>(posterior.shape(2)), peaks = static_cast<int64_t>(place.shape(1)),
                  pixels = task.height * task.width;
    expect("broad and likelihood must be of the posterior's shape", {task.height, task.width, cells}, broad,
           likelihood);
    expect("place and mass must be (pixels, peaks)", {pixels, peaks}, place, mass);
    if (size_of(signal) != pixels || size_of(down) != size_of(right) || peaks > kImageLanes)
        throw nb::value_error("signal must be (pixels), down and right of one length");
    for (int64_t k = 0; k < size_of(down); ++k)
        if (std::abs(down.data()[k]) >= task.height || std::abs(right.data()[k]) >= task.width)
            throw nb::value_error("offsets must be smaller than the image");
    for (int64_t k = 0; k < size_of(pixel); ++k)
        if (pixel.data()[k] < 0 || pixel.data()[k] >= pixels) throw nb::value_error("pixel must lie in the image");
    task.posterior = posterior.data();
    task.broad = broad.data();
    task.likelihood = likelihood.data();
    task.cells = static_cast<int>(cells);
    task.peaks = static_cast<int>(peaks);
    task.place = place.data();
    task.mass = mass.data();
    task.signal = signal.data();
    task.pixel = pixel.data();
    task.count = size_of(pixel);
    task.down = down.data();
    task.right = right.data();
    task.offsets = static_cast<int>(size_of(down));
    return task;
}

void features(Image posterior, Image broad, Image likelihood, Matrix<const float> place, Matrix<const float> mass,
              Floats signal, Vector<const int64_t> pixel, Vector<const int32_t> down, Vector<const int32_t> right,
              Image out, int threads) {
    ImageCandidates task = candidates_of(posterior, broad, likelihood, place, mass, signal, pixel, down, right);
    expect("out must be (pixels, peaks, 3 offsets + 3)", {task.count, task.peaks, 3 * task.offsets + 3}, out);
    task.features = out.data();
    watched(nb::none(), [&](const Watch& watch) { image_candidates(task, threads, watch); });
}

void choose(Image posterior, Image broad, Image likelihood, Matrix<const float> place, Matrix<const float> mass,
            Floats signal, Vector<const int64_t> pixel, Vector<const int32_t> down, Vector<const int32_t> right,
            Floats weights, int hidden, Vector<int32_t> chosen, Vector<float> confidence, int threads) {
    ImageCandidates task = candidates_of(posterior, broad, likelihood, place, mass, signal, pixel, down, right);
    const int64_t inputs = 3 * task.offsets + 3;
    if (size_of(weights) != (inputs + 1) * hidden + (hidden + 1) * hidden + hidden + 1 + 3)
        throw nb::value_error("weights must fit the offsets and `hidden`");
    if (size_of(chosen) != task.count || size_of(confidence) != task.count)
        throw nb::value_error("chosen and confidence must have one entry for each of pixel");
    task.weights = weights.data();
    task.hidden = hidden;
    task.chosen = chosen.data();
    task.confidence = confidence.data();
    watched(nb::none(), [&](const Watch& watch) { image_candidates(task, threads, watch); });
}

void centroids(const BoundImageSetting& setting, int64_t height, int64_t width, Vector<const int64_t> first,
               Vector<const int32_t> bin, Floats number, Floats ratio, Floats delay, int steps, Matrix<float> out,
               int threads) {
    const ImagePhotons photons = photons_of(height, width, first, bin, number);
    expect("out must be (pixels, 5)", {height * width, kImageColumns}, out);
    if (size_of(ratio) != height * width || size_of(delay) != height * width)
        throw nb::value_error("ratio and delay must be (pixels)");
    watched(nb::none(), [&](const Watch& watch) {
        image_centroids(setting, photons, ratio.data(), delay.data(), steps, out.data(), threads, watch);
    });
}

void planes(Image images, int64_t margin, float cells, float sigma, Vector<const int32_t> radii, Matrix<float> out,
            int threads) {
    const int64_t height = static_cast<int64_t>(images.shape(1)) - 2 * margin,
                  width = static_cast<int64_t>(images.shape(2)) - 2 * margin - kImageLanes, windows = size_of(radii);
    if (images.shape(0) != 4 || height < 1 || width < 1)
        throw nb::value_error("images must be (4, height + 2 margin, width + 2 margin + 16)");
    for (int64_t k = 0; k < windows; ++k)
        if (radii.data()[k] < 0 || radii.data()[k] > margin) throw nb::value_error("radii must lie within the margin");
    expect("out must be (height * width, windows * 7)", {height * width, windows * kImageMoments}, out);
    const int64_t size = static_cast<int64_t>(images.shape(1) * images.shape(2));
    ImagePlanes task{};
    task.number = images.data();
    task.offset = task.number + size;
    task.delay = task.offset + size;
    task.exposure = task.delay + size;
    task.width = width;
    task.margin = margin;
    task.cells = cells;
    task.sigma = sigma;
    task.radii = radii.data();
    task.windows = static_cast<int>(windows);
    task.out = out.data();
    watched(nb::none(), [&](const Watch& watch) { image_planes(task, 0, height, threads, watch); });
}

void convolve(Image images, Matrix<const float> weights, Floats bias, int side, bool rectified, Image out,
              int threads) {
    const int64_t inputs = static_cast<int64_t>(images.shape(0)), outputs = size_of(bias),
                  height = static_cast<int64_t>(images.shape(1)) - 2,
                  width = static_cast<int64_t>(images.shape(2)) - 18;
    if (side != 1 && side != 3) throw nb::value_error("side must be 1 or 3");
    expect("weights must be (inputs * side * side, outputs)", {inputs * side * side, outputs}, weights);
    expect("out must be (outputs, height, width)", {outputs, height, width}, out);
    ImageConvolution task{};
    task.in = images.data();
    task.plane = static_cast<int64_t>(images.shape(1) * images.shape(2));
    task.pitch = static_cast<int64_t>(images.shape(2));
    task.width = width;
    task.inputs = static_cast<int>(inputs);
    task.outputs = static_cast<int>(outputs);
    task.side = side;
    task.rectified = rectified;
    task.weights = weights.data();
    task.bias = bias.data();
    task.out = out.data();
    task.out_plane = height * width;
    watched(nb::none(), [&](const Watch& watch) { image_convolution(task, height, threads, watch); });
}

}  // namespace

void bind_image(nb::module_& module) {
    nb::class_<BoundImageSetting>(module, "ImageSetting", "Pulse and cells of depth from a few photons a pixel.")
        .def(
            "__init__",
            [](BoundImageSetting* self, nb::object recording, int cells, int phases, int first,
               Matrix<const float> table, float low, Floats density, Floats score, float near_low, float near_high,
               float least) {
                new (self) BoundImageSetting(setting_of(recording, cells, phases, first, table, low, density, score,
                                                        near_low, near_high, least));
            },
            "recording"_a, nb::kw_only(), "cells"_a, "phases"_a, "first"_a, "table"_a, "low"_a, "density"_a, "score"_a,
            "near_low"_a, "near_high"_a, "least"_a);
    module.def("image_likelihood", &likelihood, "setting"_a, nb::kw_only(), "height"_a, "width"_a, "first"_a, "bin"_a,
               "number"_a, "ratio"_a, "y0"_a, "x0"_a, "out"_a.noconvert(), "threads"_a,
               "Likelihoods (rows, columns, cells) of a part of an image.");
    module.def("image_posterior", &posterior, "likelihood"_a.noconvert(), "one"_a.noconvert(), "other"_a.noconvert(),
               nb::kw_only(), "narrow"_a, "wide"_a, "jump"_a, "place"_a.noconvert(), "mass"_a.noconvert(), "broad"_a,
               "threads"_a,
               "Sum-product on both comb trees: posterior into `one`, its sums over 17 cells into `other`.");
    module.def("image_features", &features, "posterior"_a.noconvert(), "broad"_a.noconvert(),
               "likelihood"_a.noconvert(), nb::kw_only(), "place"_a, "mass"_a, "signal"_a, "pixel"_a, "down"_a,
               "right"_a, "out"_a.noconvert(), "threads"_a,
               "Features (pixels, peaks, features) of the candidates of some pixels.");
    module.def("image_choose", &choose, "posterior"_a.noconvert(), "broad"_a.noconvert(), "likelihood"_a.noconvert(),
               nb::kw_only(), "place"_a, "mass"_a, "signal"_a, "pixel"_a, "down"_a, "right"_a, "weights"_a, "hidden"_a,
               "chosen"_a.noconvert(), "confidence"_a.noconvert(), "threads"_a,
               "Index of the candidate of some pixels that a network chooses, and its probability.");
    module.def("image_centroids", &centroids, "setting"_a, nb::kw_only(), "height"_a, "width"_a, "first"_a, "bin"_a,
               "number"_a, "ratio"_a, "delay"_a, "steps"_a, "out"_a.noconvert(), "threads"_a,
               "(pixels, 5): signal photons, their centroid, exposure of pulse and background, photons in the window.");
    module.def("image_planes", &planes, "images"_a.noconvert(), nb::kw_only(), "margin"_a, "cells"_a, "sigma"_a,
               "radii"_a, "out"_a.noconvert(), "threads"_a, "Planes of growing windows: (pixels, windows * 7).");
    module.def("image_convolve", &convolve, "images"_a.noconvert(), nb::kw_only(), "weights"_a, "bias"_a, "side"_a,
               "rectified"_a, "out"_a.noconvert(), "threads"_a, "Convolution (outputs, height, width) of an image.");
}

}  // namespace mars
