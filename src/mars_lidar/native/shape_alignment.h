// The shape of one pixel: a mixture of table rows, moved from the table's delay to its own, to a fraction of a bin.
//
// Inside a bin the density of registrations is lambda(x) A(x), lambda the pixel's own flux, known exactly, and A the
// mean armed fraction. A pixel is armed unless it registered within the last dead time, so the shape itself gives A
// at every edge: A(x) = 1 - [H(x) - H(x - t_d)], H the mean registrations per period up to x (docs/theory_mars.md,
// 2). Between edges A follows the depletion by the bin's own photons. A shift of the binned values themselves
// would smear a narrow pulse over another bin.
#pragma once
#include <cmath>
#include <cstdint>

#include "lanes.h"
#include "shape_kernel.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

constexpr double kLeastArmed = 1e-9;  // of a saturated pixel, where the difference leaves nothing but rounding
constexpr int kSweeps = 12;           // of the fixed point where registrations re-arm inside the pulse

struct Bump {  // hands out parts of a block of memory
    char* at;
    template <class T>
    T* take(int64_t n) {
        T* const found = reinterpret_cast<T*>(at);
        at += (n * static_cast<int64_t>(sizeof(T)) + 63) / 64 * 64;
        return found;
    }
};

class Alignment {
public:
    Alignment(const ShapeJob& job, Bump& memory) : job_(job), n_(job.bins) {
        mixture_ = memory.take<float>(padded_bins(n_) + 16) + 16;  // room for the bin before the first
        shape = memory.take<float>(padded_bins(n_));
        for (int64_t j = n_; j < padded_bins(n_); ++j) shape[j] = 0.0f;
        const PulseFrame& frame = job.frame;
        armed_ = memory.take<double>(frame.size + 1);
        moved_ = memory.take<double>(frame.size + 1);
        const double whole = std::floor(job.dead_time), back = (job.dead_time - whole) * n_;
        whole_ = whole;
        back_ = static_cast<int64_t>(back);
        part_ = back - static_cast<double>(back_);
        if (frame.cells > 1) {
            nearest_ = std::floor(job.dead_time + 0.5);
            offset_ = (job.dead_time - nearest_) * n_;
            reach_ = frame_reach(offset_);
            const int64_t cells = (frame.size + 2 * reach_) * frame.cells;
            mass_ = memory.take<double>(cells + 1);
            below_ = memory.take<double>(cells + 1);
            fine_ = memory.take<double>(cells + 1);
        }
    }

    float* shape;  // (padded_bins), zeros behind the last bin; sums to what the rows do

    void set(int64_t pixel) {
        const double shift = job_.shift ? job_.shift[pixel] * n_ : 0.0;
        int64_t whole = static_cast<int64_t>(shift);
        double part = shift - static_cast<double>(whole);
        if (part > 1.0 - 1e-9) ++whole, part = 0.0;
        if (part < 1e-9) part = 0.0;
        if (whole >= n_) whole -= n_;
        if (whole == 0 && part == 0.0) {
            mix(pixel, shape);
            return;
        }
        mix(pixel, mixture_);
        mixture_[-1] = mixture_[n_ - 1];
        const float late = static_cast<float>(part), early = 1.0f - late;
        slide(mixture_, shape + whole, n_ - whole, early, late);
        slide(mixture_ + n_ - whole, shape, whole, early, late);
        if (part > 0.0 && job_.frame.size > 0 && job_.signal[pixel] > 0.0 && job_.rate[pixel] > 0.0)
            correct(pixel, whole, part);
    }

private:
    static void slide(const float* from, float* to, int64_t n, float early, float late) {
        for (int64_t j = 0; j < n; ++j) to[j] = early * from[j] + late * from[j - 1];
    }

    void mix(int64_t pixel, float* to) const {
        const float* row[4];
        float weight[4];
        int used = 0;
        for (int k = 0; k < 4; ++k) {
            const double w = job_.weights[4 * pixel + k];
            if (!(w > 0.0)) continue;
            row[used] = job_.shapes + job_.rows[4 * pixel + k] * n_;
            weight[used++] = static_cast<float>(w);
        }
        for (; used < 4; ++used) row[used] = row[0], weight[used] = 0.0f;
        const float *a = row[0], *b = row[1], *c = row[2], *d = row[3];
        if (weight[1] == 0.0f) {
            for (int64_t j = 0; j < n_; ++j) to[j] = weight[0] * a[j];
        } else {
            for (int64_t j = 0; j < n_; ++j)
                to[j] = (weight[0] * a[j] + weight[1] * b[j]) + (weight[2] * c[j] + weight[3] * d[j]);
        }
    }

    int64_t wrap(int64_t bin) const {
        bin %= n_;
        return bin < 0 ? bin + n_ : bin;
    }

    // Sum of the mixture over `count` <= bins bins from `first` on, cyclic; sixteen sums side by side.
    double sum(int64_t first, int64_t count) const {
        double sums[16] = {};
        double total = 0.0;
        while (count > 0) {
            const int64_t here = count < n_ - first ? count : n_ - first;
            const float* from = mixture_ + first;
            int64_t j = 0;
            for (; j + 16 <= here; j += 16)
                for (int k = 0; k < 16; ++k) sums[k] += static_cast<double>(from[j + k]);
            for (; j < here; ++j) total += static_cast<double>(from[j]);
            count -= here;
            first = 0;
        }
        for (int k = 0; k < 16; ++k) total += sums[k];
        return total;
    }

    // The frame's bins again, with what the pulse leaves behind each cut.
    void correct(int64_t pixel, int64_t whole, double part) {
        const PulseFrame& frame = job_.frame;
        const double rate = job_.rate[pixel];
        arm(rate);
        if (frame.cells > 1)
            cut_cells(pixel, part, rate);
        else
            cut_bins(pixel, part);
        int64_t bin = frame.first, to = wrap(frame.first + whole);
        double before = frame.size == n_ ? moved_[n_ - 1] : part * mixture_[frame.first - 1];
        for (int32_t i = 0; i < frame.size; ++i) {
            shape[to] = static_cast<float>(mixture_[bin] - moved_[i] + before);
            before = moved_[i];
            if (++bin == n_) bin = 0;
            if (++to == n_) to = 0;
        }
        if (frame.size < n_) shape[to] = static_cast<float>((1.0 - part) * mixture_[bin] + before);
    }

    // Mean armed fraction at the frame's edges.
    void arm(double rate) {
        const PulseFrame& frame = job_.frame;
        int64_t bin = frame.first, old = wrap(frame.first - back_);
        double blind = sum(old, back_) + part_ * mixture_[old - 1];
        for (int32_t i = 0;; ++i) {
            const double armed = 1.0 - rate * (whole_ + blind);
            armed_[i] = armed > kLeastArmed ? armed : kLeastArmed;
            if (i == frame.size) return;
            const double leaving = mixture_[old], next = mixture_[old - 1];
            blind += mixture_[bin] - leaving + part_ * (leaving - next);
            if (++bin == n_) bin = 0;
            if (++old == n_) old = 0;
        }
    }

    // Registrations of a bin behind the cut at 1 - part of it; A from edge to edge as the bin's photons deplete it:
    // A = a e^-l(x) + q (1 - e^-l(x)), with q such that it ends at the next edge.
    void cut_bins(int64_t pixel, double part) {
        const PulseFrame& frame = job_.frame;
        const double place = (1.0 - part) * frame.parts;
        const int32_t p = place < frame.parts ? static_cast<int32_t>(place) : frame.parts - 1;
        const double between = place - p, signal = job_.signal[pixel], dark = job_.background[pixel] / n_;
        const float* low = frame.energy + static_cast<int64_t>(p) * frame.size;
        const float* high = low + frame.size;
        const float* all = frame.energy + static_cast<int64_t>(frame.parts) * frame.size;
        for (int32_t i = 0; i < frame.size; ++i) {
            const double photons = signal * all[i] + dark;
            const double until = signal * (low[i] + between * (high[i] - low[i])) + dark * (1.0 - part);
            const double from = armed_[i], to = armed_[i + 1], u = photons > 0.0 ? until / photons : 1.0 - part;
            const double slope = (from - to) / (1.0 - exp_minus(photons)), end = from - slope;
            const double depleted = (slope * (1.0 - exp_minus(until)) + end * until) / (from - to + end * photons);
            const double few = u * (from + 0.5 * u * (to - from)) / (0.5 * (from + to));  // A straight
            moved_[i] = photons > 1e-3 ? depleted : few;
        }
        int64_t bin = frame.first;
        for (int32_t i = 0; i < frame.size; ++i) {
            const double behind = 1.0 - moved_[i];
            moved_[i] = mixture_[bin] * (behind < 0.0 ? 0.0 : behind > 1.0 ? 1.0 : behind);
            if (++bin == n_) bin = 0;
        }
    }

    // The same where registrations of the pulse re-arm inside the pulse, and A changes within a bin by more than
    // its own photons do: cells of a bin, and A at their edges from the registrations that it gives, until both
    // agree.
    void cut_cells(int64_t pixel, double part, double rate) {
        const PulseFrame& frame = job_.frame;
        const int64_t k = frame.cells, first = reach_ * k, inside = frame.size * k;
        const int64_t bins = frame.size + 2 * reach_;
        const int32_t step = frame.parts / frame.cells;
        const double signal = job_.signal[pixel], dark = job_.background[pixel] / n_ / static_cast<double>(k);
        for (int64_t b = 0; b < bins; ++b) {
            const double each = rate * mixture_[wrap(frame.first - reach_ + b)] / static_cast<double>(k);
            for (int64_t c = 0; c < k; ++c) mass_[b * k + c] = each;
        }
        for (int64_t c = 0; c <= inside; ++c)
            fine_[c] = armed_[c / k] + (c < inside ? (armed_[c / k + 1] - armed_[c / k]) * (c % k) / k : 0.0);
        for (int sweep = 0;; ++sweep) {
            int64_t bin = frame.first;
            for (int32_t i = 0; i < frame.size; ++i) {
                double* mass = mass_ + first + i * k;
                const double* armed = fine_ + i * k;
                double total = 0.0;
                for (int64_t c = 0; c < k; ++c) {
                    const float* energy = frame.energy + c * step * frame.size + i;
                    const double photons = signal * (energy[step * static_cast<int64_t>(frame.size)] - energy[0]) + dark;
                    total += mass[c] = (photons > 0.0 ? photons : 0.0) * between(armed[c], armed[c + 1]);
                }
                const double scale = total > 0.0 ? rate * mixture_[bin] / total : 0.0;
                for (int64_t c = 0; c < k; ++c)
                    mass[c] = total > 0.0 ? mass[c] * scale : rate * mixture_[bin] / static_cast<double>(k);
                if (++bin == n_) bin = 0;
            }
            if (sweep == kSweeps) break;
            below_[0] = 0.0;
            for (int64_t c = 0; c < bins * k; ++c) below_[c + 1] = below_[c] + mass_[c];
            const double back = offset_ * static_cast<double>(k);
            for (int64_t c = 0; c <= inside; ++c) {
                const double place = static_cast<double>(first + c) - back;
                const int64_t cell = static_cast<int64_t>(place);
                const double then = below_[cell] + (place - static_cast<double>(cell)) * mass_[cell];
                const double armed = 1.0 - nearest_ * rate - (below_[first + c] - then);
                fine_[c] = armed > kLeastArmed ? armed : kLeastArmed;
            }
        }
        const double place = (1.0 - part) * static_cast<double>(k);
        const int64_t cut = place < static_cast<double>(k) ? static_cast<int64_t>(place) : k - 1;
        for (int32_t i = 0; i < frame.size; ++i) {
            const double* mass = mass_ + first + i * k;
            double behind = mass[cut] * (1.0 - (place - static_cast<double>(cut)));
            for (int64_t c = cut + 1; c < k; ++c) behind += mass[c];
            const double most = mixture_[wrap(frame.first + i)];
            moved_[i] = behind / rate < most ? behind / rate : most;
        }
    }

    // e^-x for x in [0, 700], to 1e-11 of 1: without libm, so that loops of it use vectors.
    static MARS_INLINE double exp_minus(double x) {
        const double limited = x < 700.0 ? x : 700.0;
        const double shifted = limited * 1.4426950408889634 + 6755399441055744.0;  // 1.5 x 2^52: rounds to integers
        const double whole = shifted - 6755399441055744.0;
        const double r = (limited - whole * 0.693147180369123816490) - whole * 1.90821492927058770002e-10;
        double p = 1.0 / 3628800.0;
        p = 1.0 / 362880.0 - r * p;
        p = 1.0 / 40320.0 - r * p;
        p = 1.0 / 5040.0 - r * p;
        p = 1.0 / 720.0 - r * p;
        p = 1.0 / 120.0 - r * p;
        p = 1.0 / 24.0 - r * p;
        p = 1.0 / 6.0 - r * p;
        p = 0.5 - r * p;
        p = 1.0 - r * p;
        p = 1.0 - r * p;
        uint64_t bits;
        memcpy(&bits, &shifted, sizeof bits);
        bits = (0x3ffull - bits) << 52;  // the integer is in the lowest bits
        double power;
        memcpy(&power, &bits, sizeof power);
        return p * power;
    }

    // Mean of an exponential that goes from a to b.
    static double between(double a, double b) {
        const double ratio = (b - a) / a;
        if (std::fabs(ratio) < 1e-3) return a + 0.5 * (b - a) - (b - a) * ratio / 12.0;
        return (b - a) / std::log(b / a);
    }

    const ShapeJob& job_;
    const int64_t n_;
    float* mixture_;
    double *armed_, *moved_;                                   // the frame: A at its edges; moved to the next bin
    double *mass_ = nullptr, *below_ = nullptr, *fine_ = nullptr;  // its cells, with `reach_` bins on either side
    double whole_, part_ = 0.0, nearest_ = 0.0, offset_ = 0.0;  // of the dead time: periods; bins
    int64_t back_ = 0, reach_ = 0;
};

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
