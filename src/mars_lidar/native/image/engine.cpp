// The stages of depth from a few photons a pixel: each cuts its image into rows, columns or pixels for the threads, and
// calls the widest kernel that the processor runs.
#include "image/engine.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "lanes/kernels.h"
#include "reconstruct/armed_passes.h"

namespace mars {
namespace {

constexpr double kMostBlind = 0.01;   // of the exposure: a pixel that is blind for less counts as always armed
constexpr double kOwnPhotons = 20.0;  // of signal, whose centroid is better than what is known of the surface
constexpr int64_t kPixels = 256;      // of a chunk

// How long pulses of each delay, and background, were exposed in one pixel: what its own registrations blinded is off.
class DelayExposure {
 public:
    explicit DelayExposure(const ImageSetting& s)
        : s_(s),
          r_(*s.recording),
          passes_(r_.bins),
          row_(r_.bins),
          below_(r_.bins + 1),
          cell_(s.cells),
          armed_(s.cells) {
        const ImagePulse& pulse = s.pulse;
        const float* const middle = pulse.density + static_cast<int64_t>(pulse.phases / 2) * pulse.span;
        for (int k = 0; k < pulse.span; ++k) sum_ += static_cast<double>(middle[k]);
        flat_ = !r_.gated();
        set(nullptr, nullptr, 0);
        fixed_ = armed_;
        fixed_mean_ = mean_;
    }

    // Of a pixel with these registrations. Whether anything differs from a pixel without a gate that never is blind.
    bool operator()(const int32_t* bin, const float* number, int64_t count) {
        double total = 0.0;
        for (int64_t e = 0; e < count; ++e) total += static_cast<double>(number[e]);
        const double dead = r_.dead() + (r_.synchronous ? 0.5 : 0.0);
        own_ = total * dead > kMostBlind * static_cast<double>(r_.cycles);
        if (own_) set(bin, number, count);
        return own_ || !flat_;
    }

    // (cells) exposure of a pulse over that of background.
    const float* relative() const { return own_ ? armed_.data() : fixed_.data(); }
    // Exposure of background, as a share of all cycles.
    double background() const { return own_ ? mean_ : fixed_mean_; }

    // By how much the photons of a pulse at a delay are late on average, in cells, for what was blind about it.
    double lag(int delay) const {
        if (!own_) return 0.0;
        const ImagePulse& pulse = s_.pulse;
        const float* const middle = pulse.density + static_cast<int64_t>(pulse.phases / 2) * pulse.span;
        double a = 0.0, b = 0.0, plain = 0.0;
        for (int k = 0; k < pulse.span; ++k) {
            const double q = static_cast<double>(middle[k]), late = -static_cast<double>(pulse.first + k);
            const double seen = q * cell_[wrapped(delay - pulse.first - k)];
            a += seen;
            b += seen * late;
            plain += q * late;
        }
        return a > 0.0 ? b / a - plain / sum_ : 0.0;
    }

 private:
    int64_t wrapped(int64_t i) const {
        i %= s_.cells;
        return i < 0 ? i + s_.cells : i;
    }

    void set(const int32_t* bin, const float* number, int64_t count) {
        std::fill(row_.begin(), row_.end(), 0.0);
        for (int64_t e = 0; e < count; ++e) row_[bin[e]] += static_cast<double>(number[e]);
        passes_.set(r_, {row_.data(), CountRows::Type::kDouble, r_.bins}, 0);
        below_[0] = 0.0;
        for (int64_t j = 0; j < r_.bins; ++j)
            below_[j + 1] = below_[j] + passes_.time[j] * r_.share(j) / static_cast<double>(r_.cycles);
        const auto until = [&](double x) {  // exposure up to x bins
            const int64_t j = std::min<int64_t>(static_cast<int64_t>(x), r_.bins - 1);
            return below_[j] + (x - static_cast<double>(j)) * (below_[j + 1] - below_[j]);
        };
        const double step = static_cast<double>(r_.bins) / s_.cells;
        for (int i = 0; i < s_.cells; ++i) cell_[i] = (until((i + 1) * step) - until(i * step)) / step;
        mean_ = std::max(below_[r_.bins] / static_cast<double>(r_.bins), 1e-9);
        if (flat_ && count == 0) {
            std::fill(armed_.begin(), armed_.end(), 1.0f);
            return;
        }
        const ImagePulse& pulse = s_.pulse;
        const float* const middle = pulse.density + static_cast<int64_t>(pulse.phases / 2) * pulse.span;
        for (int i = 0; i < s_.cells; ++i) {
            double value = 0.0;
            int64_t c = wrapped(static_cast<int64_t>(i) - pulse.first);
            for (int k = 0; k < pulse.span; ++k) {
                value += static_cast<double>(middle[k]) * cell_[c];
                c = c == 0 ? s_.cells - 1 : c - 1;
            }
            armed_[i] = static_cast<float>(value / (sum_ * mean_));
        }
    }

    const ImageSetting& s_;
    const HistogramRecord& r_;
    ArmedPasses passes_;
    std::vector<double> row_, below_, cell_;
    std::vector<float> armed_, fixed_;
    double sum_ = 0.0, mean_ = 1.0, fixed_mean_ = 1.0;
    bool flat_ = true, own_ = false;
};

template <class Work>
void run_rows(int64_t items, int64_t chunk, int threads, const Watch& watch, const Work& work) {
    run_chunks((items + chunk - 1) / chunk, threads, watch, [&](int64_t number, const std::atomic<bool>& stop) {
        work(number * chunk, std::min(items, (number + 1) * chunk), stop);
    });
}

}  // namespace

void image_likelihood(const ImageSetting& s, const ImagePhotons& photons, const ImagePart& part, const float* ratio,
                      float* out, int threads, const Watch& watch) {
    const auto kernel = kernel_at<const ImagePixel&>("", MARS_KERNELS(image_likelihood_));
    const int64_t across = part.x1 - part.x0;
    const float step = static_cast<float>(s.cells) / static_cast<float>(s.recording->bins);
    run_rows(part.pixels(), kPixels, threads, watch, [&](int64_t begin, int64_t end, const std::atomic<bool>& stop) {
        std::vector<float> time, scratch(2 * kImageFactors * (s.cells + s.pulse.span));
        DelayExposure exposure(s);
        ImagePixel task{&s.pulse, s.cells, 0, nullptr, nullptr, 0.0f, nullptr, s.least, scratch.data(), nullptr};
        for (int64_t k = begin; k < end && !stop; ++k) {
            const int64_t p = (part.y0 + k / across) * photons.width + part.x0 + k % across;
            const int64_t e = photons.first[p], count = photons.first[p + 1] - e;
            time.resize(count);
            for (int64_t j = 0; j < count; ++j)
                time[j] = std::min((static_cast<float>(photons.bin[e + j]) + 0.5f) * step,
                                   static_cast<float>(s.cells) - 0.001f);
            task.photons = count;
            task.time = time.data();
            task.weight = photons.counted + e;
            task.ratio = ratio[p];
            task.armed = exposure(photons.bin + e, photons.number + e, count) ? exposure.relative() : nullptr;
            task.out = out + k * s.cells;
            kernel(task);
        }
    });
}

void image_posterior(const float* likelihood, float* one, float* other, int64_t height, int64_t width, int cells,
                     const ImageLine& step, int peaks, float* place, float* mass, bool broad, int threads,
                     const Watch& watch) {
    const auto line = kernel_at<const ImageLine&>("", MARS_KERNELS(image_line_));
    const auto posterior = kernel_at<const ImagePosterior&>("", MARS_KERNELS(image_posterior_));
    const int64_t row = width * cells;
    const auto along = [&](bool rows, const float* in, float* out) {
        const int64_t lines = rows ? height : width, count = rows ? width : height;
        run_rows(lines, 4, threads, watch, [&](int64_t begin, int64_t end, const std::atomic<bool>& stop) {
            std::vector<float> scratch((count + 2) * cells + 6 * (cells + 64));
            ImageLine task = step;
            task.count = count;
            task.stride = rows ? cells : row;
            task.cells = cells;
            task.scratch = scratch.data();
            for (int64_t k = begin; k < end && !stop; ++k) {
                task.in = in + k * (rows ? row : cells);
                task.out = out + k * (rows ? row : cells);
                line(task);
            }
        });
    };
    along(true, likelihood, other);
    along(false, other, one);
    along(false, likelihood, other);
    along(true, other, other);
    run_rows(height * width, kPixels, threads, watch, [&](int64_t begin, int64_t end, const std::atomic<bool>&) {
        std::vector<float> scratch(3 * cells + 64);
        posterior({one + begin * cells, other + begin * cells, end - begin, cells, peaks, place + begin * peaks,
                   mass + begin * peaks, broad, scratch.data()});
    });
}

void image_candidates(const ImageCandidates& task, int threads, const Watch& watch) {
    const auto kernel = kernel_at<const ImageCandidates&>("", MARS_KERNELS(image_candidates_));
    const int64_t inputs = 3 * task.offsets + 3, at_once = kImageLanes / task.peaks;
    run_rows(task.count, 64 * at_once, threads, watch, [&](int64_t begin, int64_t end, const std::atomic<bool>&) {
        std::vector<float> scratch(kImageLanes * (inputs + 2 * std::max(task.hidden, 1)));
        ImageCandidates part = task;
        part.pixel += begin;
        part.count = end - begin;
        if (part.features) part.features += begin * task.peaks * inputs;
        if (part.chosen) part.chosen += begin;
        if (part.confidence) part.confidence += begin;
        part.scratch = scratch.data();
        kernel(part);
    });
}

void image_centroids(const ImageSetting& s, const ImagePhotons& photons, const float* ratio, const float* delay,
                     int steps, float* out, int threads, const Watch& watch) {
    const float period = static_cast<float>(s.cells), step = period / static_cast<float>(s.recording->bins);
    const PulseScore& pulse = s.score;
    run_rows(photons.height * photons.width, kPixels, threads, watch,
             [&](int64_t begin, int64_t end, const std::atomic<bool>& stop) {
                 DelayExposure exposure(s);
                 for (int64_t p = begin; p < end && !stop; ++p) {
                     const int64_t first = photons.first[p], last = photons.first[p + 1];
                     const bool blind = exposure(photons.bin + first, photons.number + first, last - first);
                     float offset = 0.0f, near = 0.0f, number = 0.0f;
                     const auto cell = [&] {  // of the delay, where a bright pulse blinds its own end
                         float place = delay[p] + offset;
                         place -= period * std::floor(place / period);
                         return std::min(static_cast<int>(place), s.cells - 1);
                     };
                     for (int k = 0; k < steps; ++k) {
                         double a = 0.0, b = 0.0;
                         near = 0.0f;
                         for (int64_t e = first; e < last; ++e) {
                             float u = (static_cast<float>(photons.bin[e]) + 0.5f) * step - delay[p];
                             u -= period * std::round(u / period);
                             if (u >= pulse.near_low && u < pulse.near_high) near += photons.counted[e];
                             const float x = (u - offset - pulse.low) * static_cast<float>(pulse.phases);
                             if (!(x >= 0.0f) || !(x < static_cast<float>(pulse.count))) continue;
                             const int64_t j = static_cast<int64_t>(x);
                             const float q = ratio[p] * pulse.density[j];
                             const double g = static_cast<double>(photons.counted[e] * q / (1.0f + q));
                             a += g;
                             b += g * static_cast<double>(pulse.score[j]);
                         }
                         number = static_cast<float>(a);
                         if (a > 1e-6) offset += static_cast<float>(b / a - exposure.lag(cell()));
                         if (a < kOwnPhotons) break;  // its centroid would run after its own photons
                     }
                     float* const to = out + p * kImageColumns;
                     to[0] = number;
                     to[1] = offset;
                     to[2] = static_cast<float>(exposure.background()) * (blind ? exposure.relative()[cell()] : 1.0f);
                     to[3] = static_cast<float>(exposure.background());
                     to[4] = near;
                 }
             });
}

void image_planes(const ImagePlanes& task, int64_t first, int64_t last, int threads, const Watch& watch) {
    const auto kernel = kernel_at<const ImagePlanes&>("", MARS_KERNELS(image_planes_));
    run_rows(last - first, 4, threads, watch, [&](int64_t begin, int64_t end, const std::atomic<bool>& stop) {
        for (int64_t k = begin; k < end && !stop; ++k) {
            ImagePlanes row = task;
            row.y = first + k;
            row.first = 0;
            row.last = task.width;
            row.out += k * task.width * task.windows * kImageMoments;
            kernel(row);
        }
    });
}

void image_convolution(const ImageConvolution& task, int64_t height, int threads, const Watch& watch) {
    const auto kernel = kernel_at<const ImageConvolution&>("", MARS_KERNELS(image_convolution_));
    run_rows(height, 8, threads, watch, [&](int64_t begin, int64_t end, const std::atomic<bool>& stop) {
        for (int64_t y = begin; y < end && !stop; ++y) {
            ImageConvolution row = task;
            row.y = y;
            row.out += y * task.width;
            kernel(row);
        }
    });
}

}  // namespace mars
