// Expected photons per period in the internal cells of a batch's pixels: returns of a pulse or a waveform, and
// background. Cells that no pulse reaches share one number.
#pragma once
#include "base/standard.h"
#include "feedback/kernel.h"
#include "instrument/job.h"
#include "instrument/sampled_pulse.h"

#ifndef MARS_LEVEL
#define MARS_LEVEL portable
#endif

namespace mars {
inline namespace MARS_LEVEL {

// Energy of one pulse between two times. Gaussian: the distribution function from a table by cubic Hermite
// interpolation, from the nearer tail so that small energies keep their digits (relative error 2e-7 at 6 sigma).
// Tables by the host (`PulseEnergyTables`).
struct PulseEnergy {
    static constexpr double kReach = 8.5, kCells = 64.0;  // of the table: standard deviations; cells of each

    SampledPulse sampled;          // without knots: a Gaussian
    const double *tail, *density;  // at x = k / kCells: of the normal law above x, and at x
    double scale;                  // 1 / sigma
    double low, high;              // extent

    bool gaussian() const { return sampled.knots == nullptr; }

    // Energy before a time relative to the delay, no wrapping; of a Gaussian 1 less from the delay on.
    double below(double time) const {
        if (!gaussian()) return sampled.cumulative(time);
        const double x = time * scale;
        return x < 0.0 ? above(-x) : -above(x);
    }
    // Energy from one time to a later one, given what `below` says there.
    double between(double from, double to, double below_from, double below_to) const {
        return below_to - below_from + (gaussian() && from < 0.0 && to >= 0.0 ? 1.0 : 0.0);
    }

 private:
    double above(double x) const {
        if (x >= kReach) return 0.0;
        const double place = x * kCells;
        const int64_t k = static_cast<int64_t>(place);
        const double s = place - static_cast<double>(k), h = 1.0 / kCells, r = 1.0 - s;
        return r * r * ((1.0 + 2.0 * s) * tail[k] - s * h * density[k]) +
               s * s * ((3.0 - 2.0 * s) * tail[k + 1] + r * h * density[k + 1]);
    }
};

// The lanes' photons as FeedbackBatch wants them. Each lane begins half a period before its strongest return.
template <int lanes>
class PhotonsOf {
 public:
    int32_t first_bin[lanes];
    double dark[kKinds * lanes];
    int32_t lit_begin, lit_end;

    // `lit` has room for all cells, `row` from one to the next.
    PhotonsOf(const Job& job, const PulseEnergy& energy, const FeedbackGrid& grid, const int64_t* pixels, double* lit,
              int64_t row)
        : grid_(grid), low_(energy.low), high_(energy.high), lit_(lit), row_(row) {
        for (int i = 0; i < lanes; ++i) {
            first_bin[i] = place(job, pixels[i]);
            for (int k = 0; k < kKinds; ++k) dark[k * lanes + i] = job.background[pixels[i]] * grid.width[k];
        }
        set_range(job, pixels);
        for (int32_t j = lit_begin; j < lit_end; ++j) {
            const double* level = dark + lanes * grid_.kind[j];
            for (int i = 0; i < lanes; ++i) lit_[(j - lit_begin) * row_ + i] = level[i];
        }
        for (int i = 0; i < lanes; ++i)
            for (int64_t k = 0; k < job.returns; ++k) {
                const double photons = job.signal[k * job.pixels + pixels[i]];
                if (photons > 0.0) add_return(energy, photons, offset(job, k, pixels[i], i), i);
            }
        if (job.waveform) add_waveforms(job, pixels);
    }

 private:
    static double phase(double periods) { return periods - std::floor(periods); }

    static int32_t place(const Job& job, int64_t pixel) {
        if (job.returns == 0) return 0;
        int64_t strongest = 0;
        for (int64_t k = 1; k < job.returns; ++k)
            if (job.signal[k * job.pixels + pixel] > job.signal[strongest * job.pixels + pixel]) strongest = k;
        const int32_t bin = static_cast<int32_t>(phase(job.delay[strongest * job.pixels + pixel]) * job.bins);
        const int32_t begin = bin - job.bins / 2;
        return (begin < 0 ? begin + job.bins : begin) % job.bins;
    }

    // Delay of a return in periods after the lane's begin.
    double offset(const Job& job, int64_t k, int64_t pixel, int lane) const {
        const double at = phase(job.delay[k * job.pixels + pixel]) - static_cast<double>(first_bin[lane]) / job.bins;
        return at < 0.0 ? at + 1.0 : at;
    }

    // The cell that holds an instant of [0, 1).
    int32_t cell(double at) const {
        const int32_t bin = std::min(static_cast<int32_t>(at * grid_.bins), grid_.bins - 1);
        int32_t j = grid_.bin_cell[bin];
        while (j + 1 < grid_.cells && grid_.place[j + 1] <= at) ++j;
        while (grid_.place[j] > at) --j;
        return j;
    }

    void set_range(const Job& job, const int64_t* pixels) {
        lit_begin = job.waveform ? 0 : grid_.cells;
        lit_end = job.waveform ? grid_.cells : 0;
        bool round = false;  // a pulse goes on at the other end
        for (int i = 0; i < lanes; ++i)
            for (int64_t k = 0; k < job.returns; ++k) {
                if (!(job.signal[k * job.pixels + pixels[i]] > 0.0)) continue;
                const double at = offset(job, k, pixels[i], i);
                round = round || at + low_ < 0.0 || at + high_ >= 1.0;
                if (round) break;
                lit_begin = std::min(lit_begin, cell(at + low_));
                lit_end = std::max(lit_end, cell(at + high_) + 1);
            }
        if (round) {
            lit_begin = 0;
            lit_end = grid_.cells;
        }
        if (lit_end <= lit_begin) lit_begin = lit_end = 0;
    }

    void add_return(const PulseEnergy& energy, double photons, double at, int lane) {
        const double begin = at + low_, end = at + high_;
        double turn = std::floor(begin);  // periods of the edge to come
        int32_t j = cell(begin - turn);
        double from = turn + grid_.place[j] - at, below = energy.below(from);
        while (turn + grid_.place[j] < end) {
            const double to = turn + grid_.place[j + 1] - at, next = energy.below(to);
            const double more = photons * energy.between(from, to, below, next);
            if (more > 0.0) lit_[(j - lit_begin) * row_ + lane] += more;
            from = to;
            below = next;
            if (++j == grid_.cells) {
                j = 0;
                turn += 1.0;
            }
        }
    }

    // Rates that are constant on samples.
    void add_waveforms(const Job& job, const int64_t* pixels) {
        const double scale = static_cast<double>(job.samples);
        for (int32_t j = 0; j < grid_.cells; ++j) {
            const double to = grid_.place[j + 1] * scale;
            for (double from = grid_.place[j] * scale; from < to;) {
                const int64_t k = std::min(static_cast<int64_t>(from), job.samples - 1);
                const double next = k + 1 < job.samples ? std::min(to, k + 1.0) : to, width = next - from;
                for (int i = 0; i < lanes; ++i) lit_[j * row_ + i] += width * job.waveform[pixels[i] * job.samples + k];
                from = next;
            }
        }
    }

    const FeedbackGrid& grid_;
    const double low_, high_;  // extent of the pulse
    double* const lit_;        // photons of the cells from lit_begin on
    const int64_t row_;
};
using LanePhotons = PhotonsOf<kTeam>;

}  // namespace MARS_LEVEL
}  // namespace mars
