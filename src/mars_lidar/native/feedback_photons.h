// Expected photons per period in the internal bins of a batch's pixels.
#pragma once
#include <algorithm>
#include <cmath>
#include <vector>

#include "feedback_kernel.h"
#include "job.h"
#include "pulse.h"

namespace mars {

// Energy of one pulse between two times. Gaussian: the distribution function from a table by cubic Hermite
// interpolation, from the nearer tail so that small energies keep their digits (relative error 2e-7 at 6 sigma).
class PulseEnergy {
public:
    explicit PulseEnergy(const PulseShape& shape) : shape_(shape) {
        if (!shape.gaussian()) return;
        scale_ = 1.0 / shape.sigma;
        constexpr int cells = static_cast<int>(kReach * kCells) + 2;
        for (int k = 0; k <= cells; ++k) {
            const double x = k / kCells;
            tail_.push_back(normal_cumulative(-x));
            density_.push_back(0.3989422804014326779 * exponential(0.5 * x * x));
        }
    }

    double low() const { return shape_.low(); }
    double high() const { return shape_.high(); }

    // Energy before a time relative to the delay, no wrapping; of a Gaussian 1 less from the delay on.
    double below(double time) const {
        if (!shape_.gaussian()) return shape_.cumulative(time);
        const double x = time * scale_;
        return x < 0.0 ? tail(-x) : -tail(x);
    }
    // Energy from one time to a later one, given what `below` says there.
    double between(double from, double to, double below_from, double below_to) const {
        return below_to - below_from + (shape_.gaussian() && from < 0.0 && to >= 0.0 ? 1.0 : 0.0);
    }

private:
    static constexpr double kReach = 8.5, kCells = 64.0;

    // e^-x without libm: Taylor series at x / 2^k, squared k times.
    static double exponential(double x) {
        int halvings = 0;
        for (; x > 0.125; ++halvings) x *= 0.5;
        double e = 1.0;
        for (int n = 12; n >= 1; --n) e = 1.0 - e * x / n;
        for (; halvings > 0; --halvings) e *= e;
        return e;
    }

    double tail(double x) const {
        if (x >= kReach) return 0.0;
        const double place = x * kCells;
        const size_t k = static_cast<size_t>(place);
        const double s = place - static_cast<double>(k), h = 1.0 / kCells, r = 1.0 - s;
        return r * r * ((1.0 + 2.0 * s) * tail_[k] - s * h * density_[k]) +
               s * s * ((3.0 - 2.0 * s) * tail_[k + 1] + r * h * density_[k + 1]);
    }

    const PulseShape& shape_;
    double scale_ = 0.0;  // 1 / sigma
    std::vector<double> tail_, density_;
};

// The lanes' photons as FeedbackBatch wants them. Each lane begins half a period before its strongest return.
class LanePhotons {
public:
    int32_t first_bin[kTeam];
    double dark[kTeam];
    int32_t lit_begin, lit_end;
    std::vector<double> lit;  // (lit_end - lit_begin, kTeam)

    LanePhotons(const Job& job, const PulseEnergy& energy, const FeedbackGrid& grid, const int64_t* pixels)
        : n_(grid.bins), reach_low_(energy.low() * n_), reach_high_(energy.high() * n_) {
        for (int i = 0; i < kTeam; ++i) {
            first_bin[i] = place(job, grid, pixels[i]);
            dark[i] = job.background[pixels[i]] / n_;
        }
        set_range(job, pixels);
        lit.resize(static_cast<size_t>(lit_end - lit_begin) * kTeam);
        for (size_t at = 0; at < lit.size(); ++at) lit[at] = dark[at % kTeam];
        for (int i = 0; i < kTeam; ++i) {
            for (int64_t k = 0; k < job.returns; ++k) {
                const double photons = job.signal[k * job.pixels + pixels[i]];
                if (photons > 0.0) add_return(energy, photons, offset(job, k, pixels[i], i), i);
            }
            if (job.waveform) add_waveform(job, pixels[i], i);
        }
    }

private:
    static double phase(double periods) { return periods - std::floor(periods); }

    static int32_t place(const Job& job, const FeedbackGrid& grid, int64_t pixel) {
        if (job.returns == 0) return 0;
        int64_t strongest = 0;
        for (int64_t k = 1; k < job.returns; ++k)
            if (job.signal[k * job.pixels + pixel] > job.signal[strongest * job.pixels + pixel]) strongest = k;
        const int32_t bin = static_cast<int32_t>(phase(job.delay[strongest * job.pixels + pixel]) * job.bins);
        const int32_t begin = bin - job.bins / 2;
        return (begin < 0 ? begin + job.bins : begin) % job.bins * grid.merge;
    }

    // Delay of a return in internal bins after the lane's first one.
    double offset(const Job& job, int64_t k, int64_t pixel, int lane) const {
        const double at = phase(job.delay[k * job.pixels + pixel]) * n_ - first_bin[lane];
        return at < 0.0 ? at + n_ : at;
    }

    void set_range(const Job& job, const int64_t* pixels) {
        lit_begin = job.waveform ? 0 : n_;
        lit_end = job.waveform ? n_ : 0;
        for (int i = 0; i < kTeam; ++i)
            for (int64_t k = 0; k < job.returns; ++k) {
                if (!(job.signal[k * job.pixels + pixels[i]] > 0.0)) continue;
                const double at = offset(job, k, pixels[i], i);
                const double low = std::floor(at + reach_low_), high = std::floor(at + reach_high_) + 1.0;
                lit_begin = std::min(lit_begin, static_cast<int32_t>(std::max(-1.0, low)));
                lit_end = std::max(lit_end, static_cast<int32_t>(std::min(n_ + 1.0, high)));
            }
        if (lit_begin < 0 || lit_end > n_) {  // a pulse goes on at the other end
            lit_begin = 0;
            lit_end = n_;
        }
        if (lit_end <= lit_begin) lit_begin = lit_end = 0;
    }

    void add_return(const PulseEnergy& energy, double photons, double at, int lane) {
        const int64_t first = static_cast<int64_t>(std::floor(at + reach_low_));
        const int64_t last = static_cast<int64_t>(std::floor(at + reach_high_));
        const double width = 1.0 / n_;
        int64_t bin = (first % n_ + n_) % n_;
        double from = (static_cast<double>(first) - at) * width, below = energy.below(from);
        for (int64_t edge = first; edge <= last; ++edge) {
            const double to = (static_cast<double>(edge + 1) - at) * width, next = energy.below(to);
            const double more = photons * energy.between(from, to, below, next);
            if (more > 0.0) lit[static_cast<size_t>((bin - lit_begin) * kTeam + lane)] += more;
            from = to;
            below = next;
            if (++bin == n_) bin = 0;
        }
    }

    // A rate that is constant on samples: photons before a bin's edge, differenced.
    void add_waveform(const Job& job, int64_t pixel, int lane) {
        const double* photons = job.waveform + pixel * job.samples;
        const double scale = static_cast<double>(job.samples) / n_;
        for (int32_t bin = 0; bin < n_; ++bin) {
            const double from = bin * scale, to = (bin + 1) * scale;
            double sum = 0.0;
            for (int64_t k = static_cast<int64_t>(from); k < job.samples && static_cast<double>(k) < to; ++k)
                sum += photons[k] * (std::min(to, k + 1.0) - std::max(from, static_cast<double>(k)));
            lit[static_cast<size_t>(bin) * kTeam + lane] += std::max(0.0, sum);
        }
    }

    const int32_t n_;
    const double reach_low_, reach_high_;
};

}  // namespace mars
