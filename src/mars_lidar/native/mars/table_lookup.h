// Lookup in a table over (S, B): rows and weights of the shapes, cumulants with their start-phase correction.
// Equation numbers (L1) ... are those of docs/table.md.
#pragma once
#include "numbers/elementary.h"

namespace mars {

constexpr int kCumulants = 4;

// Photons per period and their logarithm, which every axis needs.
struct TableFlux {
    double value, log;
    explicit TableFlux(double photons) : value(photons), log(photons > 0.0 ? ieee_log(photons) : 0.0) {}
};

// 1 / product over i != k of (at[k] - at[i]), of `count` <= 4 coordinates.
inline void lagrange_scales(const double* at, int count, double* scale) {
    for (int k = 0; k < count; ++k) {
        double product = 1.0;
        for (int i = 0; i < count; ++i)
            if (i != k) product *= at[k] - at[i];
        scale[k] = 1.0 / product;
    }
}

// Ascending photons per period; the first may be 0. Tables by the host (`AxisTables`).
struct Axis {
    const double* value;
    const double* log;     // (size)
    const double* scale;   // (size, 4) of the cubic that begins there
    const int64_t* start;  // (starts): last node at or below a cell of equal steps in the logarithm, or a later cell's
    int64_t size, starts;
    int64_t lowest;  // the first that has a logarithm
    double cells_per_log;
    int32_t count;  // nodes of a cubic in the logarithm
    int32_t padding;

    // The last node at or below x; the first for what is below that.
    int64_t below(const TableFlux& x) const {
        if (starts == 0 || x.value < value[lowest]) return 0;
        const int64_t last = starts - 1;
        const double cell = (x.log - log[lowest]) * cells_per_log;
        int64_t at = start[cell < static_cast<double>(last) ? std::max<int64_t>(0, static_cast<int64_t>(cell)) : last];
        while (at > lowest && value[at] > x.value) --at;  // rounding
        while (at + 1 < size && value[at + 1] <= x.value) ++at;
        return at;
    }
};

// Nodes of one axis around a value: two for the mean histogram, up to four for the cumulants.
struct Stencil {
    int64_t low, high;  // cell
    double fraction;    // of the cell, linear in the photons (L1)
    int count;          // nodes of the cumulants
    int64_t node[4];
    double weight[4];  // Lagrange, in log photons (L2)
    bool dim;          // in the cell that begins at 0
    double rise[4];    // there, of nodes above 0: slope of the weight at 0
    double bend;       // there: polynomial of slope 1 at 0 that vanishes at every node
};

// Cubic through up to four nodes at coordinates `at`.
inline void lagrange(Stencil& out, const double* at, const double* scale, double x) {
    double before[5] = {1.0}, behind = 1.0;
    for (int k = 0; k < out.count; ++k) before[k + 1] = before[k] * (x - at[k]);
    for (int k = out.count - 1; k >= 0; --k) {
        out.weight[k] = before[k] * behind * scale[k];
        behind *= x - at[k];
    }
}

// The nodes around `x` and their weights. With `nearest` one node alone, the nearer in the logarithm. Where x lies
// between 0 and the first node above it the cubic is one in the photons, because 0 has no logarithm.
MARS_APART inline Stencil stencil(const Axis& axis, const TableFlux& x, bool nearest) {
    Stencil out{};
    out.low = axis.below(x);
    out.high = std::min(out.low + 1, axis.size - 1);
    const double left = axis.value[out.low], right = axis.value[out.high];
    out.fraction = out.high > out.low ? std::clamp((x.value - left) / (right - left), 0.0, 1.0) : 0.0;
    if (nearest && out.high > out.low) {
        const bool up = left > 0.0 ? x.value * x.value > left * right : 2.0 * x.value > right;
        out.low = out.high = up ? out.high : out.low;
        out.fraction = 0.0;
    }
    out.dim = left == 0.0 && !nearest;
    if (out.high == out.low || out.fraction == 0.0) {
        out.count = 1;
        out.node[0] = out.low;
        out.weight[0] = 1.0;
    } else if (left == 0.0) {  // no logarithm: cubic in the photons, through nodes of about equal distances
        double at[4], scale[4];
        for (int64_t k = 0; k < axis.size && out.count < 4; ++k)
            if (axis.value[k] >= out.count * right) {
                at[out.count] = axis.value[k];
                out.node[out.count++] = k;
            }
        lagrange_scales(at, out.count, scale);
        lagrange(out, at, scale, x.value);
        out.bend = x.value;
        for (int k = 1; k < out.count; ++k) {
            out.bend *= 1.0 - x.value / at[k];
            out.rise[k] = scale[k];
            for (int i = 1; i < out.count; ++i)
                if (i != k) out.rise[k] *= -at[i];
        }
    } else {
        out.count = axis.count;
        const int64_t first = std::clamp(out.low - 1, axis.lowest, axis.size - out.count);
        for (int k = 0; k < out.count; ++k) out.node[k] = first + k;
        lagrange(out, axis.log + first, axis.scale + 4 * first, x.log);
    }
    return out;
}

// A table on the grid of its two axes, with the correction for the phase of the start on a coarser one. Plain pointers:
// the host's (mars/axis_tables.h) or a GPU's.
struct TableLookup {
    Axis signal, background, sub_signal, sub_background;
    const double* cumulants;  // (signal * background, 4)
    const double* limit;      // (4) slopes of them in S and in B at S = B = 0
    const double* phase;      // (phases) ascending, from 0 to 1
    int64_t phases;           // 0: no correction
    const float* correction;  // (sub_signal * sub_background, phases * 4)
    int32_t nearest, padding;

    void add(const double* values, double weight, double* out) const {
        for (int k = 0; k < kCumulants; ++k) out[k] += weight * values[k];
    }

    // The four rows around the pixel and their weights (L1): linear in the photons, each by the mean count of its
    // entry, because expected histograms add up and shapes do not.
    void rows(const Stencil& s, const Stencil& b, int64_t* row, double* weight) const {
        const int64_t i[2] = {s.low, s.high}, j[2] = {b.low, b.high};
        const double v[2] = {1.0 - s.fraction, s.fraction}, w[2] = {1.0 - b.fraction, b.fraction};
        double sum = 0.0;
        for (int m = 0; m < 4; ++m) {
            row[m] = i[m / 2] * background.size + j[m % 2];
            const double plain = v[m / 2] * w[m % 2];
            weight[m] = plain > 0.0 ? plain * cumulants[row[m] * kCumulants] : 0.0;  // mean histograms add up (L1)
            sum += weight[m];
        }
        for (int m = 0; m < 4; ++m) weight[m] = sum > 0.0 ? weight[m] / sum : v[m / 2] * w[m % 2];
    }

    // Cumulants by a cubic through the nodes of either axis (L2), in the cell that begins at S = B = 0 with the slopes that
    // they have there (L3); adds them to `out`.
    void bicubic(const Stencil& s, const Stencil& b, double* out) const {
        for (int k = 0; k < s.count; ++k)
            for (int m = 0; m < b.count; ++m)
                add(cumulants + (s.node[k] * background.size + b.node[m]) * kCumulants, s.weight[k] * b.weight[m], out);
        if (!s.dim || !b.dim) return;
        steepen(s, background.size, s.bend * (1.0 - b.fraction), out);
        steepen(b, 1, b.bend * (1.0 - s.fraction), out);
    }

    // Adds `weight` times the part of `limit` that the slope of the cubic along one axis, of nodes `stride` entries apart,
    // lacks at S = B = 0.
    void steepen(const Stencil& along, int64_t stride, double weight, double* out) const {
        add(limit, weight, out);
        for (int k = 1; k < along.count; ++k)
            add(cumulants + along.node[k] * stride * kCumulants, -weight * along.rise[k], out);
    }

    // Cumulants by the convex combination of the cell's four entries: coarser, and never out of range.
    void bilinear(const Stencil& s, const Stencil& b, double* out) const {
        for (int m = 0; m < 4; ++m) {
            const double w = (m / 2 ? s.fraction : 1.0 - s.fraction) * (m % 2 ? b.fraction : 1.0 - b.fraction);
            const int64_t row = (m / 2 ? s.high : s.low) * background.size + (m % 2 ? b.high : b.low);
            if (w > 0.0) add(cumulants + row * kCumulants, w, out);
        }
    }

    // Adds what the phase `at` at which the pulse comes changes in the cumulants: cubic over a coarser grid of S and B,
    // linear between the phases that the table holds.
    void correct(const TableFlux& s, const TableFlux& b, double at, double* out) const {
        const Stencil x = stencil(sub_signal, s, false), y = stencil(sub_background, b, false);
        const int64_t next = std::clamp<int64_t>(std::upper_bound(phase, phase + phases, at) - phase, 1, phases - 1);
        const double t = std::clamp((at - phase[next - 1]) / (phase[next] - phase[next - 1]), 0.0, 1.0);
        for (int k = 0; k < x.count; ++k)
            for (int m = 0; m < y.count; ++m) {
                const int64_t cell = x.node[k] * sub_background.size + y.node[m];
                const float* left = correction + (cell * phases + next - 1) * kCumulants;
                const double w = x.weight[k] * y.weight[m];
                for (int c = 0; c < kCumulants; ++c) out[c] += w * ((1.0 - t) * left[c] + t * left[c + kCumulants]);
            }
    }

    // Rows and weights (4) of the shapes and cumulants (4) of one pixel; a mean or variance below 0 becomes 0, and NaN
    // stays, which stands for an entry that cannot serve.
    void pixel(double signal_photons, double background_photons, double at, int64_t* row, double* weight,
               double* out) const {
        const TableFlux s(signal_photons), b(background_photons);
        const Stencil x = stencil(signal, s, nearest != 0), y = stencil(background, b, nearest != 0);
        rows(x, y, row, weight);
        std::fill(out, out + kCumulants, 0.0);
        bicubic(x, y, out);
        if (out[0] < 0.0 || out[1] < 0.0) {  // overshoot of a coarse grid: the convex combination has none
            std::fill(out, out + kCumulants, 0.0);
            bilinear(x, y, out);
        }
        if (phases > 0 && at > 0.0) {
            if (nearest)
                correct(TableFlux(signal.value[x.low]), TableFlux(background.value[y.low]), at, out);
            else
                correct(s, b, at, out);
        }
        for (int k = 0; k < 2; ++k)
            if (out[k] < 0.0) out[k] = 0.0;  // leaves NaN, which stands for an entry that cannot serve
    }
};

}  // namespace mars
