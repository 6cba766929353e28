// The likelihood of histograms in coarse bins (reconstruct/coarse_likelihood.h): how they were recorded, and its kernels.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

#include "instrument/pulse.h"
#include "lanes/levels.h"

namespace mars {

// A dead time of whole + (shift + part) / bins periods.
struct BinDelay {
    int64_t whole, shift;
    double part;

    BinDelay(double periods, int64_t bins) : whole(static_cast<int64_t>(periods)) {
        const double steps = (periods - static_cast<double>(whole)) * static_cast<double>(bins);
        shift = std::min(static_cast<int64_t>(steps + 1e-9), bins - 1);
        part = std::max(steps - static_cast<double>(shift), 0.0);
    }
};

// How histograms were recorded; times in periods. `low` and `high`: ends of the pulse, within which bins are cut.
struct CoarseRecord {
    int64_t bins, cycles, cells;  // cells of a bin that is cut; 0: none is
    double dead;
    bool stationary;
    double low, high;
    PulseShape pulse;
    int64_t rounds;    // of the distribution over cells, at most
    double tolerance;  // registrations of a cell, relative to the cycles, at which it has settled

    // Share of the registrations whose effect `periods` later lies within the exposure. Those before a stationary
    // exposure make up for the rest.
    double within(int64_t periods) const {
        return stationary ? 1.0 : std::max(0.0, 1.0 - static_cast<double>(periods) / static_cast<double>(cycles));
    }
};

// What pixels of a record have in common. Bins are numbered from the one in which `low` before the pulse lies, so that what
// the pulse reaches has the same numbers in every pixel.
struct CoarsePlan {
    CoarseRecord record;
    BinDelay delay;
    double within[3], sums[2];     // by periods after `delay.whole`; over the periods before
    int64_t first_lit, end_lit;    // bins that light of the pulse reaches; the first may be negative
    int64_t pulsed = 0;            // bins of the pulse that are cut
    std::vector<int64_t> cut;      // bins that are cut, those of the pulse first
    std::vector<int64_t> place;    // their places, by bin, or -1
    std::vector<int64_t> order;    // of the places, in which registrations lead from one to the next
    std::vector<uint8_t> depends;  // bins that are not cut but re-armed from bins that are

    explicit CoarsePlan(const CoarseRecord& of) : record(of), delay(of.dead, of.bins) {
        const int64_t n = of.bins;
        for (int k = 0; k < 3; ++k) within[k] = of.within(delay.whole + k);
        for (int k = 0; k < 2; ++k) {
            sums[k] = 0.0;
            for (int64_t p = 1; p < delay.whole + k; ++p) sums[k] += of.within(p);
        }
        // The pulse begins anywhere in bin 0: what is x after it lies in bin floor(n x) or in the next.
        const int64_t reach = std::min(bin_of(of.high - of.low) + 2, n);
        first_lit = std::min<int64_t>(bin_of(of.pulse.low() - of.low), 0);
        end_lit = std::max(bin_of(of.pulse.high() - of.low) + 2, reach);
        if (end_lit - first_lit > n) {
            first_lit = 0;
            end_lit = n;
        }
        place.assign(n, -1);
        depends.assign(n, 0);
        if (of.cells == 0 || of.dead == 0.0) return;
        // the bins of the pulse, and those where its registrations re-arm the pixel, once and twice
        const double again = of.dead - std::floor(of.dead), once = nearest(of.dead), twice = nearest(2.0 * of.dead);
        const bool backward = (std::fabs(once) < std::fabs(twice) ? once : twice) < 0.0;
        std::vector<std::pair<double, int64_t>> origin;  // bins of the pulse that lead to a bin of `cut`, and its place
        for (int times = 0; times < (of.cells > 1 ? 3 : 1); ++times) {
            const int64_t first = bin_of(times * again), end = bin_of(times * again + of.high - of.low) + 2;
            for (int64_t i = first; i < std::min(end, first + n); ++i) {
                const int64_t j = i % n;
                if (place[j] >= 0) continue;
                const double led = static_cast<double>(i) - times * again * static_cast<double>(n);
                place[j] = static_cast<int64_t>(cut.size());
                origin.emplace_back(backward ? 2.0 * times - led : 2.0 * times + led, place[j]);
                cut.push_back(j);
            }
            if (times == 0) pulsed = static_cast<int64_t>(cut.size());
        }
        std::sort(origin.begin(), origin.end());
        for (const auto& each : origin) order.push_back(each.second);
        for (const int64_t j : cut)
            for (const int64_t later : {delay.shift, delay.shift + 1}) {
                const int64_t to = (j + later) % n;
                depends[to] = place[to] < 0;
            }
    }

 private:
    static double nearest(double periods) { return periods - std::floor(periods + 0.5); }  // after whole periods
    int64_t bin_of(double periods) const {
        return static_cast<int64_t>(std::floor(periods * static_cast<double>(record.bins)));
    }
};

// Logarithms of the likelihood of `counts` (pixels, bins) with their derivatives (pixels, 4 or 16) at `light` (pixels, 3):
// signal and background in photons per period, the delay in periods of [0, 1).
struct CoarseBlock {
    const CoarsePlan& plan;
    const double *counts, *light;
    double* out;
    int64_t pixels;
};

constexpr int64_t kCoarseTogether = 32;  // pixels in a block: whole vectors of every level

MARS_DECLARE_KERNEL(void, coarse_gradient_, const CoarseBlock& block)
MARS_DECLARE_KERNEL(void, coarse_curvature_, const CoarseBlock& block)  // of the base level alone: it is larger

}  // namespace mars
