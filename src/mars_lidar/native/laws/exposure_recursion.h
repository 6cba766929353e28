// The delay recursion through one laser period of a free-running pixel: what of it is armed, and what each bin
// registers, which re-arms a dead time later (docs/theory_exposure.md, (7) to (15)). The numbers are a template's:
// series for cumulants, complex ones for the generating function.
#pragma once
#include <algorithm>
#include <vector>

#include "laws/exposure_bin.h"

namespace mars {
inline namespace MARS_LEVEL {

constexpr int kMarks = 64;  // phases at which the state is sampled, to see whether it repeats

struct Cut {
    int32_t bin;
    bool mark;
};

// Edges at which the loop over the bins of a period stops, in order: the marks, where the source period changes, and
// where the last d bins begin.
inline std::vector<Cut> cuts_of(const ExposureGrid& grid) {
    const int32_t n = grid.bins;
    const int marks = std::min<int32_t>(kMarks, n);
    std::vector<Cut> cuts;
    for (int m = 1; m <= marks; ++m) cuts.push_back({static_cast<int32_t>(int64_t{n} * m / marks), true});
    if (grid.shift > 0)
        for (const int32_t bin : {grid.shift, n - grid.shift})
            cuts.insert(std::find_if(cuts.begin(), cuts.end(), [&](const Cut& cut) { return cut.bin > bin; }),
                        Cut{bin, false});
    return cuts;
}

// N: what a probability is weighted with (Series or Complex). C: Real where the lanes are different pixels,
// double where they are one pixel at different weights.
template <class N, class C>
class Recursion {
 public:
    // `history`: stationary registrations of the period before the exposure (n bins), or null for an armed start.
    // `keep_period`: the registrations of the last period can be read back by `last_period`.
    Recursion(const ExposureGrid& grid, const std::vector<Response<C>>& response, const Registrations<Real>* history,
              bool keep_period = false)
        : grid_(grid),
          response_(response),
          history_(history),
          shift_(grid.fraction),
          delay_(grid.delay()),
          ring_(std::max<int64_t>(delay_ > 0 ? grid.memory() : 0, keep_period ? grid.bins : 0)),
          cuts_(cuts_of(grid)) {
        repeated.resize(2 * std::min<int32_t>(kMarks, grid.bins));
    }

    N armed{};                // at the start of the period, then at its end
    N total{};                // registrations of the period
    N tail{};                 // and of its last d + f bins
    std::vector<N> repeated;  // registrations between marks and armed probabilities at marks, last period

    // Dead time below one bin and a stationary start: the bin before the exposure.
    void set_last(const Registrations<N>& last) { last_ = last; }

    // Registrations of period q, the last one, bin by bin.
    Registrations<N> last_period(int64_t q, int32_t bin) const { return ring_[slot(q * grid_.bins + bin)]; }

    // Advances by period number q. `old_weight` and `new_weight` are the factors z x (change of unit) of
    // registrations made K + 1 and K periods ago; `histogram` (n), or null, gains the unweighted registrations.
    void period(int64_t q, const N& old_weight, const N& new_weight, Real* histogram) {
        total = tail = sum_ = N{};
        N segment{};
        size_t mark = 0;
        int32_t from = 0;
        if (delay_ > 0) start_period(q, old_weight);
        for (const Cut& cut : cuts_) {
            while (from < cut.bin) {
                const int32_t to = delay_ > 0 ? contiguous(q, from, cut.bin) : cut.bin;
                if (delay_ > 0)
                    advance(q, from, to, from < grid_.shift ? old_weight : new_weight, histogram);
                else
                    advance_self(q, from, to, old_weight, new_weight, histogram);
                from = to;
            }
            total = total + sum_;
            segment = segment + sum_;
            if (cut.bin > grid_.bins - grid_.shift) tail = tail + sum_;
            if (cut.bin == grid_.bins - grid_.shift && grid_.fraction > 0.0) {
                const Registrations<N>& edge = delay_ > 0 ? ring_[slot(q * grid_.bins + cut.bin - 1)] : last_;
                tail = shift_.far[0][0] * edge.mass + shift_.far[0][1] * edge.moment;
            }
            sum_ = N{};
            if (cut.mark) {
                repeated[mark++] = segment;
                repeated[mark++] = armed;
                segment = N{};
            }
        }
    }

 private:
    int64_t slot(int64_t bin) const { return bin % static_cast<int64_t>(ring_.size()); }

    // Registrations of global bin `g`, which may lie before the exposure.
    Registrations<N> past(int64_t g, const N& weight) const {
        if (g >= 0) {
            const Registrations<N>& r = ring_[slot(g)];
            return {weighted(weight, r.mass), weighted(weight, r.moment)};
        }
        if (!history_) return Registrations<N>{};
        const int64_t n = grid_.bins;
        return before(history_[(g % n + n) % n], weight);
    }

    // A registration before the exposure re-arms without weight: see `history_weight` of the callers.
    static Registrations<N> before(const Registrations<Real>& r, const N& weight) {
        return {r.mass * weight, r.moment * weight};
    }

    void start_period(int64_t q, const N& old_weight) {
        if (grid_.fraction == 0.0) return;
        const int64_t g = q * grid_.bins - delay_ - 1;
        // with d = 0 the bin before the period's first belongs to the period K + 1 ago all the same
        last_ = past(g, old_weight);
    }

    // End of the run from bin `from` over which both the source and the target lie contiguously in memory.
    int32_t contiguous(int64_t q, int32_t from, int32_t to) const {
        const int64_t g = q * grid_.bins + from, size = static_cast<int64_t>(ring_.size());
        int64_t run = std::min<int64_t>(to - from, size - slot(g));
        const int64_t source = g - delay_;
        if (source >= 0)
            run = std::min(run, size - slot(source));
        else
            run = std::min(run, -source);
        return from + static_cast<int32_t>(run);
    }

    void advance(int64_t q, int32_t from, int32_t to, const N& weight, Real* histogram) {
        const int64_t g = q * grid_.bins + from, source = g - delay_;
        Registrations<N>* out = ring_.data() + slot(g);
        const Response<C>* response = response_.data() + from;
        Real* bins = histogram ? histogram + from : nullptr;
        const int32_t count = to - from;
        if (source >= 0) {
            const Registrations<N>* in = ring_.data() + slot(source);
            auto load = [in, &weight](int32_t j) {
                return Registrations<N>{weighted(weight, in[j].mass), weighted(weight, in[j].moment)};
            };
            grid_.fraction > 0.0 ? run<true>(count, load, response, out, bins)
                                 : run<false>(count, load, response, out, bins);
        } else if (history_) {
            const int64_t n = grid_.bins;
            int32_t phase = static_cast<int32_t>((source % n + n) % n);
            const Registrations<Real>* history = history_;
            auto load = [history, phase, n, &weight](int32_t j) {
                const int64_t k = phase + j;
                return before(history[k < n ? k : k - n], weight);
            };
            grid_.fraction > 0.0 ? run<true>(count, load, response, out, bins)
                                 : run<false>(count, load, response, out, bins);
        } else {
            auto load = [](int32_t) { return Registrations<N>{}; };
            run<false>(count, load, response, out, bins);
            last_ = Registrations<N>{};
        }
    }

    template <bool fractional, class Load>
    void run(int32_t count, const Load& load, const Response<C>* response, Registrations<N>* out, Real* histogram) {
        N a = armed, sum = sum_;
        Registrations<N> last = last_;
        const Shift s = shift_;
        for (int32_t j = 0; j < count; ++j) {
            Registrations<N> in = load(j);
            if constexpr (fractional) {
                const Registrations<N> now = in;
                in.mass = (s.near[0][0] * now.mass + s.near[0][1] * now.moment) +
                          (s.far[0][0] * last.mass + s.far[0][1] * last.moment);
                in.moment = (s.near[1][0] * now.mass + s.near[1][1] * now.moment) +
                            (s.far[1][0] * last.mass + s.far[1][1] * last.moment);
                last = now;
            }
            const Response<C>& r = response[j];
            const N mass = r.mass_armed * a + (r.mass_in * in.mass + r.mass_slope * in.moment);
            const N moment = r.moment_armed * a + (r.moment_in * in.mass + r.moment_slope * in.moment);
            a = (a + in.mass) - mass;
            sum = sum + mass;
            out[j] = {mass, moment};
            if (histogram) histogram[j] += leading(mass);
        }
        armed = a;
        sum_ = sum;
        last_ = last;
    }

    // Dead time below one bin: a bin re-arms into itself as well (eq. 14). `last_` carries the bin before,
    // `first_weight` its weight when that bin belongs to the previous period.
    void advance_self(int64_t q, int32_t from, int32_t to, const N& first_weight, const N& weight, Real* histogram) {
        N a = armed, sum = sum_;
        Registrations<N> last = last_;
        for (int32_t j = from; j < to; ++j) {
            const Response<C>& r = response_[j];
            const N& w = j == 0 ? first_weight : weight;
            const N far_mass = shift_.far[0][0] * last.mass + shift_.far[0][1] * last.moment;
            const N far_moment = shift_.far[1][0] * last.mass + shift_.far[1][1] * last.moment;
            const N in_mass = weighted(w, far_mass), in_moment = weighted(w, far_moment);
            Registrations<N> out;
            out.mass = r.mass_armed * a + (r.mass_in * in_mass + r.mass_slope * in_moment);
            out.moment = r.moment_armed * a + (r.moment_in * in_mass + r.moment_slope * in_moment);
            C self[2][2];
            for (int k = 0; k < 2; ++k) {
                self[0][k] = r.mass_in * shift_.near[0][k] + r.mass_slope * shift_.near[1][k];
                self[1][k] = r.moment_in * shift_.near[0][k] + r.moment_slope * shift_.near[1][k];
            }
            solve_self(weight, self, out.mass, out.moment);
            const N near = shift_.near[0][0] * out.mass + shift_.near[0][1] * out.moment;
            a = (a + in_mass + weighted(weight, near)) - out.mass;
            sum = sum + out.mass;
            last = out;
            if (!ring_.empty()) ring_[slot(q * grid_.bins + j)] = out;
            if (histogram) histogram[j] += leading(out.mass);
        }
        armed = a;
        sum_ = sum;
        last_ = last;
    }

    template <int T>
    static Real leading(const Series<T>& x) {
        return x.c[0];
    }
    static Real leading(const Complex& x) { return x.re; }

    ExposureGrid grid_;
    const std::vector<Response<C>>& response_;
    const Registrations<Real>* history_;
    Shift shift_;
    int64_t delay_;
    std::vector<Registrations<N>> ring_;
    std::vector<Cut> cuts_;
    N sum_{};
    Registrations<N> last_{};
};

}  // namespace MARS_LEVEL
}  // namespace mars
