// The shape of one pixel: a mixture of table rows, moved from the table's delay to its own, to a fraction of a bin.
//
// Inside a bin the density of registrations is lambda(x) A(x), lambda the pixel's own flux, known exactly, and A the
// mean armed fraction. A pixel is armed unless it registered within the last dead time, so the shape itself gives A
// at every edge: A(x) = 1 - [H(x) - H(x - t_d)], H the mean registrations per period up to x (docs/theory_mars.md,
// (2.1)). Between edges A follows the depletion by the bin's own photons. A shift of the binned values themselves
// would smear a narrow pulse over another bin.
#pragma once
#include "mars/shape_mixture.h"
#include "numbers/elementary.h"
#include "numbers/lane_math.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

constexpr double kLeastArmed = 1e-9;  // of a saturated pixel, where the difference leaves nothing but rounding
constexpr float kFewPhotons = 0.01f;  // in a bin, below which A is as good as straight in it
constexpr double kBright = 2.0;       // photons per period from which the slope inside a bin shows
constexpr int kSweeps = 12;           // of the fixed point where registrations re-arm inside the pulse

// The shape of one pixel after another. Outside of the pulse's frame it is the mixture moved by part of a bin; in the
// frame, what a bin registers before and after the cut follows from the pixel's flux and the mean armed fraction at the
// bin's edges.
template <class Team>
class Alignment : public Mixture<Team> {
    using Base = Mixture<Team>;
    using Base::job_, Base::team_, Base::n_, Base::mixture_, Base::past_;
    using Base::mix, Base::mix_cyclic, Base::copy_cyclic, Base::sum, Base::wrap;
    using Base::move, Base::past_even, Base::past_sloped;

 public:
    Alignment(const ShapeJob& job, Bump& memory, const Team& team) : Base(job, memory, team) {
        shape = memory.take<float>(padded_bins(n_));
        const PulseFrame& frame = job.frame;
        wide_ = (frame.size + kLanes) / kLanes * kLanes + 1;  // whole lanes, and one more
        here_ = memory.take<float>(wide_);
        old_ = memory.take<float>(wide_);
        armed_ = memory.take<float>(wide_);
        moved_ = memory.take<float>(wide_);
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

    // Once, before anything else.
    void clear() {
        const int64_t n = n_;
        float *const to = shape, *const here = here_, *const armed = armed_;
        team_.each(padded_bins(n) - n, [=](int64_t j) { to[n + j] = 0.0f; });
        team_.each(wide_, [=](int64_t i) { here[i] = armed[i] = 0.0f; });
    }

    float* shape;  // (padded_bins), zeros behind the last bin; sums to what the rows do

    void set(int64_t pixel) {
        const Move move_by = moved_by(pixel);
        const int64_t whole = move_by.whole;
        const double part = move_by.part;
        if (whole == 0 && part == 0.0) {
            mix(pixel, 0, n_, shape);
            return;
        }
        mix(pixel, 0, n_, mixture_);
        team_.once([&] {
            mixture_[-1] = mixture_[n_ - 1];
            mixture_[n_] = mixture_[0];
        });
        const float late = static_cast<float>(part);
        if (job_.signal[pixel] + job_.background[pixel] < kBright)
            past_even(late);
        else
            past_sloped(late);
        team_.once([&] { past_[-1] = past_[n_ - 1]; });
        move(0, shape + whole, n_ - whole);
        move(n_ - whole, shape, whole);
        if (part > 0.0 && has_pulse(pixel)) correct(pixel, whole, part);
    }

    // The bin a dead time, less whole periods, before the frame; and less part of a bin.
    int64_t first_old() const { return wrap(job_.frame.first - back_ - 1); }

    // How far a pixel's shape moves: whole bins, and a part of one.
    struct Move {
        int64_t whole;
        double part;
    };
    Move moved_by(int64_t pixel) const {
        const double shift = job_.shift ? job_.shift[pixel] * n_ : 0.0;
        int64_t whole = static_cast<int64_t>(shift);
        double part = shift - static_cast<double>(whole);
        if (part > 1.0 - 1e-9) ++whole, part = 0.0;
        if (part < 1e-9) part = 0.0;
        if (whole >= n_) whole -= n_;
        return {whole, part};
    }

    // The frame alone, for a pixel that `set` would spread evenly and cut by bins: out (size + 1), what moves into
    // each of its bins, and at last into the one behind; their sum. `blind`: the mixture's sum over the dead time
    // before the frame.
    double set_frame(int64_t pixel, double part, double blind, double* out) {
        const PulseFrame& frame = job_.frame;
        mix_cyclic(pixel, frame.first, frame.size, here_);
        if (part > 0.0 && has_pulse(pixel)) {
            mix_cyclic(pixel, first_old(), frame.size + 1, old_);
            arm(job_.rate[pixel], blind);
            cut_bins(pixel, part);
        } else {
            const float late = static_cast<float>(part), *const here = here_;
            float* const moved = moved_;
            team_.each(frame.size, [=](int64_t i) { moved[i] = late * here[i]; });
        }
        return team_.agreed([&] {
            double before = 0.0, total = 0.0;
            for (int32_t i = 0; i < frame.size; ++i) {
                out[i] = static_cast<double>(here_[i] - moved_[i]) + before;
                before = static_cast<double>(moved_[i]);
                total += out[i];
            }
            out[frame.size] = before;
            return total + before;
        });
    }

 private:
    bool has_pulse(int64_t pixel) const {
        return job_.frame.size > 0 && job_.signal[pixel] > 0.0 && job_.rate[pixel] > 0.0;
    }

    // The frame's bins again, with what the pulse leaves behind each cut.
    void correct(int64_t pixel, int64_t whole, double part) {
        const PulseFrame& frame = job_.frame;
        const double rate = job_.rate[pixel];
        copy_cyclic(frame.first, frame.size, here_);
        copy_cyclic(first_old(), frame.size + 1, old_);
        const double until = sum(wrap(frame.first - back_), back_);
        arm(rate, team_.agreed([&] { return until + part_ * old_[0]; }));
        if (frame.cells > 1)
            cut_cells(pixel, part, rate);
        else
            cut_bins(pixel, part);
        const int64_t first = wrap(frame.first + whole), size = frame.size, n = n_;
        const int64_t behind = wrap(frame.first + size);
        const float *const here = here_, *const moved = moved_;
        const float* const ahead = size == n ? moved_ + n - 1 : past_ + frame.first - 1;
        float* const out = shape;
        team_.each(size, [=](int64_t i) {
            const int64_t to = first + i < n ? first + i : first + i - n;
            out[to] = here[i] - moved[i] + (i > 0 ? moved[i - 1] : *ahead);
        });
        if (size < n)
            team_.once([&] { shape[wrap(first + size)] = mixture_[behind] - past_[behind] + moved_[size - 1]; });
    }

    // Mean armed fraction at the frame's edges, from the mixture's sum over the dead time before it.
    void arm(double rate, double blind) {
        const int32_t size = job_.frame.size;
        team_.once([&] {
            for (int32_t i = 0;; ++i) {
                const double armed = 1.0 - rate * (whole_ + blind);
                armed_[i] = static_cast<float>(armed > kLeastArmed ? armed : kLeastArmed);
                if (i == size) return;
                const double leaving = old_[i + 1], next = old_[i];
                blind += static_cast<double>(here_[i]) - leaving + part_ * (leaving - next);
            }
        });
    }

    // Registrations of a bin behind the cut at 1 - part of it; A from edge to edge as the bin's photons deplete it:
    // A = a e^-l(x) + q (1 - e^-l(x)), with q such that it ends at the next edge.
    void cut_bins(int64_t pixel, double part) {
        const PulseFrame& frame = job_.frame;
        const double place = (1.0 - part) * frame.parts;
        const int32_t p = place < frame.parts ? static_cast<int32_t>(place) : frame.parts - 1;
        const float between = static_cast<float>(place - p), first = static_cast<float>(1.0 - part);
        const float signal = static_cast<float>(job_.signal[pixel]);
        const float dark = static_cast<float>(job_.background[pixel] / n_), early = first * dark;
        const float* low = frame.energy + static_cast<int64_t>(p) * frame.size;
        const float* high = low + frame.size;
        const float* all = frame.energy + static_cast<int64_t>(frame.parts) * frame.size;
        const int32_t size = frame.size;
        const float *const armed = armed_, *const all_here = here_;
        float* const moved = moved_;
        team_.lanes(size, [=](int64_t i) {
            const int32_t left = size - static_cast<int32_t>(i);
            const Float head = load_some(low + i, left);
            const Float photons = load_some(all + i, left) * signal + dark;
            const Float until = (head + (load_some(high + i, left) - head) * between) * signal + early;
            const Float from = load<Float>(armed + i), to = load<Float>(armed + i + 1), drop = from - to;
            const Float here = load<Float>(all_here + i);
            const Float x = minimum(maximum(photons, splat(kFewPhotons)), splat(80.0f)), u = minimum(until, x);
            const Float slope = drop / one_minus_exp(x, exp_minus(x));
            const Float depleted =
                (slope * one_minus_exp(u, exp_minus(u)) + (from - slope) * u) / (drop + (from - slope) * x);
            const Float share = until / maximum(photons, splat(1e-30f));
            const Float straight = share * (from - 0.5f * (share * drop)) / (from - 0.5f * drop);
            const Float ahead = select(photons < kFewPhotons, straight, depleted);
            const Float kept = minimum(maximum(ahead, splat(0.0f)), splat(1.0f));
            store(moved + i, here - here * kept);
        });
    }

    // The first of them, and zeros.
    static MARS_INLINE Float load_some(const float* from, int32_t left) {
        if (left >= kLanes) return load<Float>(from);
        alignas(64) float part[kLanes] = {};
        for (int32_t k = 0; k < left; ++k) part[k] = from[k];
        return load<Float>(part);
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
        team_.each(bins, [&](int64_t b) {
            const double each = rate * mixture_[wrap(frame.first - reach_ + b)] / static_cast<double>(k);
            for (int64_t c = 0; c < k; ++c) mass_[b * k + c] = each;
        });
        team_.each(inside + 1, [&](int64_t c) {
            fine_[c] = armed_[c / k] +
                       (c < inside ? static_cast<double>(armed_[c / k + 1] - armed_[c / k]) * (c % k) / k : 0.0);
        });
        for (int sweep = 0;; ++sweep) {
            team_.each(frame.size, [&](int64_t i) {
                double* mass = mass_ + first + i * k;
                const double* armed = fine_ + i * k;
                const int64_t bin = frame.first + i < n_ ? frame.first + i : frame.first + i - n_;
                double total = 0.0;
                for (int64_t c = 0; c < k; ++c) {
                    const float* energy = frame.energy + c * step * frame.size + i;
                    const float* next = energy + step * static_cast<int64_t>(frame.size);
                    const double photons = signal * (next[0] - energy[0]) + dark;
                    total += mass[c] = (photons > 0.0 ? photons : 0.0) * between(armed[c], armed[c + 1]);
                }
                const double scale = total > 0.0 ? rate * mixture_[bin] / total : 0.0;
                for (int64_t c = 0; c < k; ++c)
                    mass[c] = total > 0.0 ? mass[c] * scale : rate * mixture_[bin] / static_cast<double>(k);
            });
            if (sweep == kSweeps) break;
            team_.once([&] {
                below_[0] = 0.0;
                for (int64_t c = 0; c < bins * k; ++c) below_[c + 1] = below_[c] + mass_[c];
            });
            const double back = offset_ * static_cast<double>(k);
            team_.each(inside + 1, [&](int64_t c) {
                const double place = static_cast<double>(first + c) - back;
                const int64_t cell = static_cast<int64_t>(place);
                const double then = below_[cell] + (place - static_cast<double>(cell)) * mass_[cell];
                const double armed = 1.0 - nearest_ * rate - (below_[first + c] - then);
                fine_[c] = armed > kLeastArmed ? armed : kLeastArmed;
            });
        }
        const double place = (1.0 - part) * static_cast<double>(k);
        const int64_t cut = place < static_cast<double>(k) ? static_cast<int64_t>(place) : k - 1;
        team_.each(frame.size, [&](int64_t i) {
            const double* mass = mass_ + first + i * k;
            double behind = mass[cut] * (1.0 - (place - static_cast<double>(cut)));
            for (int64_t c = cut + 1; c < k; ++c) behind += mass[c];
            const double most = mixture_[wrap(frame.first + i)];
            moved_[i] = static_cast<float>(behind / rate < most ? behind / rate : most);
        });
    }

    // Mean of an exponential that goes from a to b.
    static double between(double a, double b) {
        const double ratio = (b - a) / a;
        if (std::fabs(ratio) < 1e-3) return a + 0.5 * (b - a) - (b - a) * ratio / 12.0;
        return (b - a) / ieee_log(b / a);
    }

    int64_t wide_;
    float *here_, *old_;                                           // the mixture in the frame; a dead time before it
    float *armed_, *moved_;                                        // A at its edges; moved to the next bin
    double *mass_ = nullptr, *below_ = nullptr, *fine_ = nullptr;  // its cells, with `reach_` bins on either side
    double whole_, part_ = 0.0, nearest_ = 0.0, offset_ = 0.0;     // of the dead time: periods; bins
    int64_t back_ = 0, reach_ = 0;
};

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
