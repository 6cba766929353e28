// A stream of one pixel as a recorder writes it, and its counts in cells (src/mars_lidar/calibration/cells.py).
#pragma once
#include <algorithm>
#include <cstdint>
#include <utility>
#include <vector>

#include "numbers/elementary.h"
#include "numbers/word_stream.h"

namespace mars {

// The whole number below x, by a conversion: the baseline's std::floor is a call.
inline double whole_below(double x) {
    const double whole = static_cast<double>(static_cast<int64_t>(x));
    return whole > x ? whole - 1.0 : whole;
}

// What a recorder writes for a time: the nearest point of a grid. `unit` its spacing (0: any real number), `offset` where
// its points lie, in units; `locked` whether the grid begins anew with each laser pulse.
struct RecorderClock {
    double period;
    double unit;
    double offset;
    bool locked;

    double operator()(double t) const {
        if (unit == 0.0) return t;
        const double start = locked ? whole_below(t * (1.0 / period)) * period : 0.0;
        const double steps = whole_below((t - start) * (1.0 / unit) + (0.5 - offset));
        return (steps + offset) * unit + start;
    }
};

// Normal deviates of one stream, each the sum of two quantiles, of 16 random bits, of a normal law of variance 1/2.
class NormalDeviates {
 public:
    NormalDeviates(uint64_t seed, uint32_t stream)
        : quantiles_(quantiles()), words_(word_stream(stream_key(seed ^ 0x6a69747465720000u, 0, stream))) {}

    double operator()() {
        const uint32_t word = words_.next();
        return static_cast<double>(quantiles_[word & 0xffffu] + quantiles_[word >> 16]);
    }

 private:
    static const float* quantiles() {
        static const std::vector<float> of = [] {
            std::vector<float> out(1 << 16);
            for (size_t k = 0; k < out.size(); ++k)
                out[k] = static_cast<float>(std::sqrt(0.5) * normal_quantile((static_cast<double>(k) + 0.5) * 0x1p-16));
            return out;
        }();
        return of.data();
    }

    const float* quantiles_;
    WordStream<uint32_t> words_;
};

// Sorts times of which jitter has exchanged few.
inline void sort_nearly_sorted(double* t, int64_t n) {
    for (int64_t k = 1; k < n; ++k) {
        const double value = t[k];
        int64_t at = k;
        for (; at > 0 && t[at - 1] > value; --at) t[at] = t[at - 1];
        t[at] = value;
    }
}

// Cells of a stream: of phases, of intervals, and of (class of the interval, class of the phase at its begin, does it
// end in a pulse), in this order. `phase_of`, `class_of` (even numbers) and `lit_of` (0 or 1) have one entry for each of
// equal parts of the period; `age_of` one for each cell of the intervals.
struct StreamCells {
    double period, shift;  // shift of the parts, in periods
    std::vector<int32_t> phase_of, class_of, lit_of;
    std::vector<double> gap_edges;
    std::vector<int32_t> age_of;
    int64_t phases, classes, ages;

    int64_t gaps() const { return static_cast<int64_t>(gap_edges.size()) + 1; }
    int64_t size() const { return phases + gaps() + ages * classes; }
};

// Counts streams, each interval by a look-up in equal parts up to the last edge.
class StreamCounter {
 public:
    explicit StreamCounter(const StreamCells& cells) : cells_(cells), first_(kParts + 1) {
        const double top = cells.gap_edges.empty() ? 1.0 : cells.gap_edges.back();
        scale_ = kParts / top;
        for (int64_t k = 0, edge = 0; k <= kParts; ++k) {
            const double begin = static_cast<double>(k) / scale_ * (1.0 - 1e-9);
            while (edge + 1 < cells.gaps() && cells.gap_edges[edge] < begin) ++edge;
            first_[k] = edge;
        }
    }

    // Adds the counts of sorted times t (n) to out (pieces, size): a row for each of equal pieces of time, the last without
    // end. An interval belongs to the piece in which it ends.
    void operator()(const double* t, int64_t n, double* out, int64_t pieces, double length) const {
        const double rate = 1.0 / cells_.period, parts = static_cast<double>(cells_.phase_of.size());
        int64_t begin = 0;  // class of the phase of the time before
        for (int64_t k = 0; k < n; ++k) {
            double phase = t[k] * rate + cells_.shift;
            phase -= whole_below(phase);
            const size_t part = std::min(static_cast<size_t>(phase * parts), cells_.phase_of.size() - 1);
            const int64_t piece = std::min(static_cast<int64_t>(std::max(t[k], 0.0) / length), pieces - 1);
            double* const row = out + piece * cells_.size();
            row[cells_.phase_of[part]] += 1.0;
            if (k > 0) {
                const int64_t gap = gap_of(t[k] - t[k - 1]);
                double* const gaps = row + cells_.phases;
                gaps[gap] += 1.0;
                gaps[cells_.gaps() + cells_.age_of[gap] * cells_.classes + begin + cells_.lit_of[part]] += 1.0;
            }
            begin = cells_.class_of[part];
        }
    }

 private:
    static constexpr int64_t kParts = 4096;

    // Number of edges below an interval.
    int64_t gap_of(double interval) const {
        const double place = std::max(interval, 0.0) * scale_;
        int64_t gap = first_[place < kParts ? static_cast<int64_t>(place) : kParts];
        while (gap < static_cast<int64_t>(cells_.gap_edges.size()) && cells_.gap_edges[gap] < interval) ++gap;
        return gap;
    }

    const StreamCells& cells_;
    std::vector<int64_t> first_;
    double scale_ = 1.0;
};

}  // namespace mars
