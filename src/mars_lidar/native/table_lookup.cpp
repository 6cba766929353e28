// Lookup in a table over (S, B): rows and weights of the shapes, cumulants with their start-phase correction.
// Equation numbers (L1) ... are those of docs/table.md.
#include <algorithm>
#include <cmath>
#include <vector>

#include "bindings.h"
#include "parallel.h"

namespace mars {

namespace {

constexpr int64_t kBlock = 512;  // pixels per chunk
constexpr int kCumulants = 4;

// Photons per period and their logarithm, which every axis needs.
struct Flux {
    double value, log;
    explicit Flux(double photons) : value(photons), log(photons > 0.0 ? std::log(photons) : 0.0) {}
};

// 1 / product over i != k of (at[k] - at[i]), of `count` <= 4 coordinates.
void lagrange_scales(const double* at, int count, double* scale) {
    for (int k = 0; k < count; ++k) {
        double product = 1.0;
        for (int i = 0; i < count; ++i)
            if (i != k) product *= at[k] - at[i];
        scale[k] = 1.0 / product;
    }
}

// Ascending photons per period; the first may be 0.
struct Axis {
    const double* value;
    int64_t size;
    std::vector<double> log;
    int64_t lowest;             // the first that has a logarithm
    int count;                  // nodes of a cubic in the logarithm
    std::vector<double> scale;  // (size, 4) of the cubic that begins there
    std::vector<int64_t> start;  // last node at or below a cell of equal steps in the logarithm, or a later cell's
    double cells_per_log = 0.0;

    explicit Axis(const Vector<const double>& values)
        : value(values.data()), size(static_cast<int64_t>(values.shape(0))), lowest(size > 1 && value[0] <= 0.0) {
        for (int64_t k = 0; k < size; ++k) log.push_back(value[k] > 0.0 ? std::log(value[k]) : 0.0);
        count = static_cast<int>(std::min<int64_t>(4, size - lowest));
        scale.resize(static_cast<size_t>(4 * size));
        for (int64_t first = lowest; first + count <= size; ++first)
            lagrange_scales(log.data() + first, count, scale.data() + 4 * first);
        const int64_t cells = 2 * size;
        const double range = size > 0 ? log.back() - log[static_cast<size_t>(lowest)] : 0.0;
        if (!(range > 0.0)) return;
        cells_per_log = static_cast<double>(cells) / range;
        int64_t at = lowest;
        for (int64_t c = 0; c <= cells; ++c) {
            while (at + 1 < size && (log[at + 1] - log[lowest]) * cells_per_log <= static_cast<double>(c)) ++at;
            start.push_back(at);
        }
    }

    // The last node at or below x; the first for what is below that.
    int64_t below(const Flux& x) const {
        if (start.empty() || x.value < value[lowest]) return 0;
        const int64_t last = static_cast<int64_t>(start.size()) - 1;
        const double cell = (x.log - log[lowest]) * cells_per_log;
        int64_t at = start[cell < static_cast<double>(last) ? std::max<int64_t>(0, static_cast<int64_t>(cell)) : last];
        while (at > lowest && value[at] > x.value) --at;  // rounding
        while (at + 1 < size && value[at + 1] <= x.value) ++at;
        return at;
    }
};

// Nodes of one axis around a value: two for the mean histogram, up to four for the cumulants.
struct Stencil {
    int64_t low, high;        // cell
    double fraction;          // of the cell, linear in the photons (L1)
    int count;                // nodes of the cumulants
    int64_t node[4];
    double weight[4];         // Lagrange, in log photons (L2)
};

// Cubic through up to four nodes at coordinates `at`.
void lagrange(Stencil& out, const double* at, const double* scale, double x) {
    double before[5] = {1.0}, behind = 1.0;
    for (int k = 0; k < out.count; ++k) before[k + 1] = before[k] * (x - at[k]);
    for (int k = out.count - 1; k >= 0; --k) {
        out.weight[k] = before[k] * behind * scale[k];
        behind *= x - at[k];
    }
}

Stencil stencil(const Axis& axis, const Flux& x, bool nearest) {
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
    } else {
        out.count = axis.count;
        const int64_t first = std::clamp(out.low - 1, axis.lowest, axis.size - out.count);
        for (int k = 0; k < out.count; ++k) out.node[k] = first + k;
        lagrange(out, axis.log.data() + first, axis.scale.data() + 4 * first, x.log);
    }
    return out;
}

struct Lookup {
    Axis signal, background, sub_signal, sub_background;
    const double* cumulants;  // (signal * background, 4)
    const double* phase;      // (phases) ascending, from 0 to 1
    int64_t phases;           // 0: no correction
    const float* correction;  // (sub_signal * sub_background, phases * 4)
    bool nearest;

    void add(const double* values, double weight, double* out) const {
        for (int k = 0; k < kCumulants; ++k) out[k] += weight * values[k];
    }

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

    void bicubic(const Stencil& s, const Stencil& b, double* out) const {
        for (int k = 0; k < s.count; ++k)
            for (int m = 0; m < b.count; ++m)
                add(cumulants + (s.node[k] * background.size + b.node[m]) * kCumulants, s.weight[k] * b.weight[m], out);
    }

    void bilinear(const Stencil& s, const Stencil& b, double* out) const {
        for (int m = 0; m < 4; ++m) {
            const double w = (m / 2 ? s.fraction : 1.0 - s.fraction) * (m % 2 ? b.fraction : 1.0 - b.fraction);
            const int64_t row = (m / 2 ? s.high : s.low) * background.size + (m % 2 ? b.high : b.low);
            if (w > 0.0) add(cumulants + row * kCumulants, w, out);
        }
    }

    void correct(const Flux& s, const Flux& b, double at, double* out) const {
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

    void pixel(double signal_photons, double background_photons, double at, int64_t* row, double* weight,
               double* out) const {
        const Flux s(signal_photons), b(background_photons);
        const Stencil x = stencil(signal, s, nearest), y = stencil(background, b, nearest);
        rows(x, y, row, weight);
        std::fill(out, out + kCumulants, 0.0);
        bicubic(x, y, out);
        if (out[0] < 0.0 || out[1] < 0.0) {  // overshoot of a coarse grid: the convex combination has none
            std::fill(out, out + kCumulants, 0.0);
            bilinear(x, y, out);
        }
        if (phases > 0 && at > 0.0) {
            if (nearest)
                correct(Flux(signal.value[x.low]), Flux(background.value[y.low]), at, out);
            else
                correct(s, b, at, out);
        }
        for (int k = 0; k < 2; ++k)
            if (out[k] < 0.0) out[k] = 0.0;  // leaves NaN, which stands for an entry that cannot serve
    }
};

void lookup(Vector<const double> signal_axis, Vector<const double> background_axis, Matrix<const double> entries,
            Vector<const double> sub_signal, Vector<const double> sub_background, Vector<const double> phase,
            Matrix<const float> correction, Vector<const double> signal, Vector<const double> background,
            Vector<const double> at, bool nearest, Matrix<int64_t> rows, Matrix<double> weights,
            Matrix<double> cumulants, int threads) {
    const Lookup table{Axis(signal_axis), Axis(background_axis), Axis(sub_signal), Axis(sub_background),
                       entries.data(), phase.data(), static_cast<int64_t>(phase.shape(0)), correction.data(), nearest};
    const int64_t pixels = static_cast<int64_t>(signal.shape(0));
    const size_t sub = sub_signal.shape(0) * sub_background.shape(0);
    if (table.signal.size < 1 || table.background.size < 1 || entries.shape(1) != kCumulants ||
        entries.shape(0) != signal_axis.shape(0) * background_axis.shape(0))
        throw nb::value_error("entries must be (signal * background, 4)");
    if (table.phases == 1 || (table.phases > 1 && (sub == 0 || correction.shape(0) != sub ||
                                                    correction.shape(1) != phase.shape(0) * kCumulants)))
        throw nb::value_error("correction must be (sub_signal * sub_background, phases * 4)");
    if (background.shape(0) != signal.shape(0) || at.shape(0) != signal.shape(0))
        throw nb::value_error("signal, background and at must agree");
    if (rows.shape(0) != signal.shape(0) || weights.shape(0) != signal.shape(0) ||
        cumulants.shape(0) != signal.shape(0) || rows.shape(1) != 4 || weights.shape(1) != 4 ||
        cumulants.shape(1) != kCumulants)
        throw nb::value_error("rows, weights and cumulants must be (pixels, 4)");
    run_chunks((pixels + kBlock - 1) / kBlock, threads, nb::none(), [&](int64_t block, const std::atomic<bool>&) {
        const int64_t last = std::min(pixels, (block + 1) * kBlock);
        for (int64_t p = block * kBlock; p < last; ++p)
            table.pixel(signal.data()[p], background.data()[p], at.data()[p], rows.data() + 4 * p,
                        weights.data() + 4 * p, cumulants.data() + kCumulants * p);
    });
}

}  // namespace

void bind_table(nb::module_& module) {
    module.def("table_lookup", &lookup, nb::kw_only(), nb::arg("signal_axis"), nb::arg("background_axis"),
               nb::arg("entries"), nb::arg("sub_signal"), nb::arg("sub_background"), nb::arg("phase"),
               nb::arg("correction"), nb::arg("signal"), nb::arg("background"), nb::arg("at"), nb::arg("nearest"),
               nb::arg("rows"), nb::arg("weights"), nb::arg("cumulants"), nb::arg("threads"));
}

}  // namespace mars
