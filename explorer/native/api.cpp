// What the explorer's page calls, of the package's own native sources compiled to WebAssembly: drawing exposures, the
// recursions behind the exact laws, and the estimators. No physics of its own. Exceptions are off and a throw ends the
// instance, so the page checks what it hands over; arrays are allocated by it with `malloc`. Seeds come as two numbers
// of 32 bits, times in laser periods.
#include <emscripten.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <memory>
#include <vector>

#include "base/integers.h"
#include "exact/engine.h"
#include "image/solver.h"
#include "instrument/job.h"
#include "instrument/pulse_table.h"
#include "instrument/recording.h"
#include "lanes/kernels.h"
#include "laws/exposure_kernel.h"
#include "laws/joint_folded.h"
#include "reconstruct/maximizer.h"

using namespace mars;

namespace {

const std::atomic<bool> kRun{false};  // nothing stops a run but the end of its worker

// Tables of the last pulses asked for; those of a pulse take longer to make than a small exposure.
const PulseTable& pulse_of(double sigma) {
    static std::vector<std::unique_ptr<PulseTable>> kept;
    for (size_t k = 0; k < kept.size(); ++k)
        if (kept[k]->shape.sigma == sigma) {
            std::rotate(kept.begin(), kept.begin() + static_cast<int64_t>(k),
                        kept.begin() + static_cast<int64_t>(k) + 1);
            return *kept.front();
        }
    kept.insert(kept.begin(), std::make_unique<PulseTable>(PulseTable::gaussian(sigma)));
    if (kept.size() > 8) kept.pop_back();
    return *kept.front();
}

ExposureGrid grid_of(const double* told) {
    ExposureGrid grid;
    grid.cycles = static_cast<int64_t>(told[0]);
    grid.max_periods = static_cast<int64_t>(told[1]);
    grid.whole = static_cast<int64_t>(told[2]);
    grid.bins = static_cast<int32_t>(told[3]);
    grid.out_bins = static_cast<int32_t>(told[4]);
    grid.shift = static_cast<int32_t>(told[5]);
    grid.fraction = told[6];
    grid.stationary = told[7] != 0.0;
    grid.tolerance = told[8];
    grid.warm_periods = static_cast<int64_t>(told[9]);
    return grid;
}

const int32_t kFirstShape = 0;
const double kOne = 1.0, kNone = 0.0;

// The light of one pixel: photons of each quarter of a bin, or of a paralyzable pixel their total and its `rates`.
ExposureLight light_of(const ExposureGrid& grid, const double* photons, const double* rates) {
    ExposureLight light{1, &kOne, &kNone, &kFirstShape, photons, grid.bins};
    light.total = photons;
    light.rates = rates;
    light.kinds = grid.stationary ? 1 : kRateKinds;
    return light;
}

// The same pixel as the joint law sees it, and its stationary registrations (n, 2); none where sweeps do not find them.
struct Folded {
    std::vector<double> response, state;
    FeedbackGrid grid{};

    Folded(const ExposureGrid& told, const double* photons) : response(static_cast<size_t>(told.bins) * 6) {
        bin_responses(photons, told.bins, response.data());
        grid = {response.data(), 0, told.bins, told.shift, told.fraction};
        const size_t n = static_cast<size_t>(told.bins);
        std::vector<Pair> unit(n);
        const FoldedSweeps done = folded_registrations(grid, grid.row(0), grid.row(3), unit.data(), 400, 1e-10);
        grid.whole = told.whole;
        if (!(done.error <= 1e-10)) return;
        double sum = 0.0;
        for (const Pair& x : unit) sum += x.mass;
        const double share = 1.0 / (1.0 + static_cast<double>(told.whole) * sum);  // (4.5)
        for (const Pair& x : unit) {
            state.push_back(share * x.mass);
            state.push_back(share * x.moment);
        }
    }
};

// `told`: cycles, bins, whole, shift and fraction of the dead time on the bins, stationary, synchronous, first knot of the
// pulse, cell, width, core low, core high. `curve` (2, knots): energy below each knot, and density. `open` (2, bins): the
// open part of each bin, or null.
HistogramRecord record_of(const double* told, int32_t knots, const double* curve, const double* open) {
    HistogramRecord record;
    record.cycles = static_cast<int64_t>(told[0]);
    record.bins = static_cast<int64_t>(told[1]);
    record.whole = static_cast<int64_t>(told[2]);
    record.shift = static_cast<int64_t>(told[3]);
    record.fraction = told[4];
    record.stationary = told[5] != 0.0;
    record.synchronous = told[6] != 0.0;
    record.pulse.low = told[7];
    record.pulse.cell = told[8];
    record.width = told[9];
    record.core_low = told[10];
    record.core_high = told[11];
    record.pulse.energy.assign(curve, curve + knots);
    record.pulse.slope.assign(curve + knots, curve + 2 * static_cast<int64_t>(knots));
    if (open) {
        record.low.assign(open, open + record.bins);
        record.high.assign(open + record.bins, open + 2 * record.bins);
    }
    return record;
}

// The cells of a Gaussian pulse, blurred by a Gaussian, both in periods: as reconstruction/image_pulse.py has it.
std::unique_ptr<ImageSetting> image_setting(const HistogramRecord& record, double width, double blur) {
    const double bins = static_cast<double>(record.bins), sigma = std::hypot(width, blur),
                 each = std::hypot(sigma, 1.0 / std::sqrt(12.0) / bins);
    const int cells = 16 * static_cast<int>(std::ceil(1.5 / each / 16.0));
    const double step = 1.0 / (int64_t{cells} * kImagePhases), reach = 8.5 * width + 4.5 * blur + 0.5 / bins;
    const int64_t first = static_cast<int64_t>(std::floor(-reach / step)),
                  count = static_cast<int64_t>(std::ceil(reach / step)) - first;
    std::vector<double> density(count), score(count);
    double energy = 0.0, moment = 0.0;
    for (int64_t j = 0; j < count; ++j) {
        const double x = score[j] = (static_cast<double>(first + j) + 0.5) * step, half = 0.5 / bins;
        density[j] = (normal_cumulative((x + half) / sigma) - normal_cumulative((x - half) / sigma)) * bins;
        energy += density[j];
        moment += density[j] * x;
    }
    for (double& x : score) x -= moment / energy;
    return std::make_unique<ImageSetting>(record, cells, first, density, score, each * cells);
}

}  // namespace

extern "C" {

// Draws histograms `out` (pixels, bins), uint32. `signal` and `delay`: (returns, pixels). `told`: cycles, bins, dead
// time, stationary, mode, gate start, gate width, mean of the afterpulses, their mean delay, twilight, electronics dead
// time, sigma of the jitter.
EMSCRIPTEN_KEEPALIVE void simulate(double sigma, const double* told, int32_t pixels, int32_t returns,
                                   const double* signal, const double* delay, const double* background,
                                   const uint32_t* pixel_index, uint32_t seed_low, uint32_t seed_high,
                                   int32_t realizations, uint32_t* out) {
    Job job;
    job.pixels = pixels;
    job.returns = returns;
    job.realizations = realizations;
    job.seed = static_cast<uint64_t>(seed_high) << 32 | seed_low;
    job.cycles = static_cast<int32_t>(told[0]);
    job.bins = static_cast<int32_t>(told[1]);
    job.dead_time = told[2];
    job.stationary = told[3] != 0.0;
    job.mode = static_cast<DetectorMode>(static_cast<int32_t>(told[4]));
    job.gate = {told[5], told[6], 0.0, 1};
    job.traps.mean = told[7];
    job.traps.mean_delay = told[8];
    job.twilight = told[9];
    job.signal = signal;
    job.delay = delay;
    job.background = background;
    job.pixel_index = pixel_index;
    Recording recording;
    recording.electronics_dead_time = told[10];
    if (told[11] > 0.0) recording.jitter = &pulse_of(told[11]);
    // the kernel of avalanches records through a Recorder even where it changes nothing, and address 0 is legal here
    if (told[10] > 0.0 || told[11] > 0.0 || job.avalanches_matter()) job.recording = &recording;
    Output output{};
    output.sink = Sink::kHistogram32;
    output.out = out;
    run_exact(job, pulse_of(sigma), output, 1, "", {});
}

// Energy `out` (n) of the train of pulses up to times `t` (n) after the delay.
EMSCRIPTEN_KEEPALIVE void energy_before(double sigma, const double* t, int32_t n, double* out) {
    PulseShape shape;
    shape.sigma = sigma;
    for (int32_t k = 0; k < n; ++k) out[k] = shape.periodic(t[k]);
}

// Cumulants (4) and mean histogram (out bins), and the periods it took: see MomentsBlock. `photons` (4 bins), or for a
// paralyzable pixel their total, and its `rates`. `rate_out` (4 + out bins) is scratch.
EMSCRIPTEN_KEEPALIVE double exposure_moments(const double* grid_told, const double* photons, const double* rates,
                                             double* cumulants, double* histogram, double* rate_out) {
    const ExposureGrid grid = grid_of(grid_told);
    const ExposureLight light = light_of(grid, photons, rates);
    int64_t settled = 0;
    MomentsBlock block{&grid, &light, histogram, &settled, cumulants, rate_out, rate_out + kExposureOrders};
    block.count = 1;
    block.stop = &kRun;
    rates ? MARS_JOIN(exposure_paralyzable_, MARS_BASE_LEVEL)(block)
          : MARS_JOIN(exposure_moments_, MARS_BASE_LEVEL)(block);
    return static_cast<double>(settled);
}

// E z^N at `count` points of the unit circle; the periods the slowest took, or a code of `settled`.
EMSCRIPTEN_KEEPALIVE double characteristic(const double* grid_told, const double* photons, const double* rates,
                                           int32_t count, const double* z_re, const double* z_im, double* re,
                                           double* im) {
    const ExposureGrid grid = grid_of(grid_told);
    const ExposureLight light = light_of(grid, photons, rates);
    constexpr int kLanesAtOnce = MARS_JOIN(kDoubles_, MARS_BASE_LEVEL);
    int64_t settled[kLanesAtOnce], slowest = 0;
    for (int32_t first = 0; first < count; first += kLanesAtOnce) {
        const int64_t some = std::min<int64_t>(kLanesAtOnce, count - first);
        MARS_JOIN(exposure_characteristic_, MARS_BASE_LEVEL)
        ({&grid, &light, 0, some, false, z_re + first, z_im + first, re + first, im + first, settled, &kRun});
        for (int64_t k = 0; k < some; ++k) {
            if (settled[k] < kRanToEnd) return static_cast<double>(settled[k]);
            slowest = std::max(slowest, settled[k] == kRanToEnd ? grid.cycles : settled[k]);
        }
    }
    return static_cast<double>(slowest);
}

// Probability that a standard normal number is below each of `t` (n).
EMSCRIPTEN_KEEPALIVE void normal_below(const double* t, int32_t n, double* out) {
    for (int32_t k = 0; k < n; ++k) out[k] = normal_cumulative(t[k]);
}

// Variances of windows of the histogram, weights (windows, out bins), of an exposure of grid.cycles periods that is
// carried through all of them (docs/joint_law.md, section 6). 0 where its stationary start is not found by sweeps.
EMSCRIPTEN_KEEPALIVE int32_t window_variances(const double* grid_told, const double* photons, int32_t windows,
                                              const double* weights, double* variances) {
    const ExposureGrid told = grid_of(grid_told);
    const Folded folded(told, photons);
    if (told.stationary && folded.state.empty()) return 0;
    std::vector<double> column(static_cast<size_t>(told.out_bins));
    ExposureColumn exposure(folded.grid, told.cycles, told.stationary ? folded.state.data() : nullptr, told.out_bins);
    for (int32_t w = 0; w < windows; ++w) {
        const double* weight = weights + static_cast<int64_t>(w) * told.out_bins;
        exposure.run(weight, column.data(), kRun);
        double sum = 0.0;
        for (int32_t j = 0; j < told.out_bins; ++j) sum += weight[j] * column[j];
        variances[w] = sum;
    }
    return 1;
}

// Periods after which an exposure that starts armed registers as a stationary one does (docs/joint_law.md, section 7);
// -1 where it ends before that, -2 where it is given up after `most_steps` bins.
EMSCRIPTEN_KEEPALIVE double settling_periods(const double* grid_told, const double* photons, double tolerance,
                                             double most_steps) {
    const ExposureGrid told = grid_of(grid_told);
    const Folded folded(told, photons);
    if (folded.state.empty()) return -2.0;
    std::vector<double> total(static_cast<size_t>(told.bins));
    return static_cast<double>(settling_time(folded.grid, told.cycles, folded.state.data(), tolerance,
                                             static_cast<int64_t>(most_steps), total.data(), kRun));
}

// Maximum likelihood of pixels from histograms (pixels, bins), uint32, recorded as record_of has it. `out` (pixels, 8) and
// `flags` (pixels): see Maximizer.
EMSCRIPTEN_KEEPALIVE void maximum_likelihood(const double* told, int32_t knots, const double* curve, const double* open,
                                             int32_t pixels, const uint32_t* counts, int32_t starts, double least_gain,
                                             double* out, uint8_t* flags) {
    const HistogramRecord record = record_of(told, knots, curve, open);
    const CountRows rows{counts, CountRows::Type::kUint32, record.bins};
    Maximizer maximizer(record, {starts, least_gain, true});
    for (int32_t p = 0; p < pixels; ++p) maximizer(rows, p, out + int64_t{kMaximumColumns} * p, flags + p);
}

// Maps (kImageMaps, pixels) of an image of histograms (height, width, bins) from its photons and those around each pixel
// (image/solver.h), bright pixels by maximum likelihood. `weights` of both networks, whose `card` is the factor of their
// intervals and the limits (4, 2); of a Gaussian pulse.
EMSCRIPTEN_KEEPALIVE void image_maps(const double* told, int32_t knots, const double* curve, const double* open,
                                     int32_t height, int32_t width, const uint32_t* counts, int32_t starts,
                                     double least_gain, const float* weights, const double* card, double* maps) {
    const HistogramRecord record = record_of(told, knots, curve, open);
    const int64_t pixels = int64_t{height} * width, bins = record.bins;
    std::vector<int64_t> first(1, 0);
    std::vector<int32_t> bin;
    std::vector<float> number;
    for (int64_t p = 0; p < pixels; ++p) {
        for (int32_t j = 0; j < bins; ++j) {
            if (counts[p * bins + j] == 0) continue;
            bin.push_back(j);
            number.push_back(static_cast<float>(counts[p * bins + j]));
        }
        first.push_back(static_cast<int64_t>(bin.size()));
    }
    ImageNetworks networks;
    networks.weights.assign(weights, weights + ImageNetworks::kChoose + ImageNetworks::kWeigh);
    networks.interval_factor = card[0];
    networks.interval_exponent = card[1];
    std::copy(card + 2, card + 10, &networks.limits[0][0]);
    constexpr double kMostCells = 4096.0;
    std::vector<std::unique_ptr<ImageSetting>> settings;
    settings.push_back(image_setting(record, record.width, 0.0));
    const int finest = settings[0]->cells;
    if (finest > kMostCells)
        for (double blur = 1.5 / (kMostCells - 16.0);; blur *= 0.5) {
            if (image_setting(record, record.width, 0.5 * blur)->cells >= finest) break;
            settings.insert(settings.end() - 1, image_setting(record, record.width, blur));
        }
    std::vector<const ImageSetting*> given;
    for (const auto& each : settings) given.push_back(each.get());
    std::vector<uint8_t> flags(pixels);
    ImageSolver solver({height, width, first.data(), bin.data(), number.data(), number.data()}, nullptr, 16 << 20,
                       1 << 14, 1);
    solver.solve(given, &networks, maps, flags.data(), {});

    const CountRows rows{counts, CountRows::Type::kUint32, record.bins};
    Maximizer maximizer(record, {starts, least_gain, true});
    for (int64_t p = 0; p < pixels; ++p) {
        if (!(maps[kImageNumber * pixels + p] > kImageBright)) continue;
        double own[kMaximumColumns], off;
        uint8_t flag;
        maximizer(rows, p, own, &flag);
        off = own[2] - maps[kImageDelay * pixels + p];
        off -= std::round(off);
        if (flag || !(std::abs(off) * settings.back()->cells < 3.0 * settings.back()->sigma)) continue;
        maps[kImageDelay * pixels + p] = own[2];
        maps[kImageHalfWidth * pixels + p] = 1.6448536269514722 * own[5];  // 90 % of a normal distribution
    }
}

}  // extern "C"
