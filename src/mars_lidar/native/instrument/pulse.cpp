// Exact pulse shapes and the sampler's tables. IEEE arithmetic only (no libm), so that the tables, and with
// them every cube, are the same to the last bit on every machine.
#include "instrument/pulse_table.h"

#include <algorithm>
#include <cmath>
#include <cstring>

namespace mars {
namespace {

constexpr double kGaussianReach = 8.5;  // half support in sigma: 1e-17 = 2^-56.4 of the energy lies outside
constexpr int kForwardCellsPerSigma = 256;

}  // namespace

double PulseShape::low() const { return gaussian() ? -kGaussianReach * sigma : start; }

double PulseShape::high() const {
    return gaussian() ? kGaussianReach * sigma : start + width * static_cast<double>(knots.size() - 1);
}

double PulseShape::cumulative(double t) const {
    if (gaussian()) return normal_cumulative(t / sigma);
    return sampled().cumulative(t);
}

double PulseShape::periodic(double t) const {
    const double whole = std::floor(t - high());
    const double rest = t - whole;  // in [high, high + 1): later pulses may have begun
    const int pulses = static_cast<int>(std::ceil(high() - low())) + 1;
    double total = whole;
    for (int k = 0; k < pulses; ++k) total += cumulative(rest - k);
    return total;
}

double PulseShape::equivalent_width() const {
    if (gaussian()) return 3.5449077018110318 * sigma;  // 2 sqrt(pi) sigma
    double square = 0.0;
    for (size_t k = 0; k + 1 < knots.size(); ++k) square += (knots[k + 1] - knots[k]) * (knots[k + 1] - knots[k]);
    return width / square;
}

namespace {

// Cells of the tables of small energies: the leading bits of a float32, so that each octave has as many cells as any
// other and small energies are looked up to the same relative precision.
int32_t octave_cell(float p) {
    uint32_t word;
    std::memcpy(&word, &p, sizeof word);
    return static_cast<int32_t>(word >> kOctaveShift);
}

// Lower edge of a cell of the octave table, the inverse of octave_cell.
float octave_edge(int32_t cell) {
    const uint32_t word = static_cast<uint32_t>(cell) << kOctaveShift;
    float p;
    std::memcpy(&p, &word, sizeof p);
    return p;
}

// Frame and forward table from the energy at the edges of equal cells, `late` counted from the end.
void build_forward(PulseTable& table, const std::vector<double>& early, const std::vector<double>& late, int split) {
    const int cells = static_cast<int>(early.size()) - 1;
    table.cells = cells;
    table.split = static_cast<float>(early[split]);
    table.late_cell = split + 1;                  // behind the guard cell
    table.forward.assign(2 * (cells + 2), 0.0f);  // one guard cell without energy at either end
    for (int k = 0; k < cells; ++k) {
        const double begin = k < split ? early[k] : late[k];
        const double end = k < split ? early[k + 1] : late[k + 1];
        table.forward[2 * (k + 1)] = static_cast<float>(begin);
        table.forward[2 * (k + 1) + 1] = static_cast<float>(end - begin);
    }
}

// Where a cumulative energy is p < 1/2: Newton's method between `from` and the median at 0, kept inside the bracket by
// bisection.
template <class Below, class Density>
double solved(const Below& below, const Density& density, double p, double from) {
    double a = from, b = 0.0, v = from;
    for (int step = 0; step < 60; ++step) {
        const double error = below(v) - p;
        if (std::fabs(error) <= 1e-14 * p) break;
        (error < 0 ? a : b) = v;
        const double newton = v - error / density(v), middle = 0.5 * (a + b);
        if (!(newton > a && newton < b) && (middle == a || middle == b)) return middle;  // no number between
        v = newton > a && newton < b ? newton : middle;
    }
    return v;
}

double normal_density(double x) { return 0.3989422804014326779 * exponential_function(-0.5 * x * x); }

// Quantiles of the normal law at the edges of the octave table's cells up to 1/2: they take most of the time of a table.
const std::vector<double>& normal_quantiles() {
    static const std::vector<double> quantiles = [] {
        std::vector<double> at(octave_cell(0.5f) + 1);
        double from = -kGaussianReach;
        for (int32_t cell = octave_cell(std::ldexp(1.0f, -kOctaves)); octave_edge(cell) < 0.5f; ++cell)
            at[cell] = from = solved(normal_cumulative, normal_density, octave_edge(cell), from);
        return at;
    }();
    return quantiles;
}

// The tables of a Gaussian pulse. Where it is longer than a period, its neighbours overlap in the frame and are added
// up; energies of the early half count from the start, those of the late half from the end, so that both tails keep
// their digits.
void build_gaussian(PulseTable& table) {
    const PulseShape& shape = table.shape;
    const double half = std::min(0.5, shape.high());
    const int half_cells = std::max(256, static_cast<int>(std::ceil(half / shape.sigma * kForwardCellsPerSigma)));
    const double width = half / half_cells;
    // Energy of the frame [-1/2, 1/2) below v, for v <= 0: the pulse's own tail and its neighbours' overlaps.
    const int reach = half < 0.5 ? 0 : static_cast<int>(std::ceil(shape.high())) + 1;
    double outside = 0.0;
    for (int k = -reach; reach > 0 && k <= reach; ++k) outside += normal_cumulative((-0.5 + k) / shape.sigma);
    auto below = [&](double v) {
        double sum = -outside;
        for (int k = -reach; k <= reach; ++k) sum += normal_cumulative((v + k) / shape.sigma);
        return sum;
    };
    std::vector<double> early(2 * half_cells + 1), late(2 * half_cells + 1);
    for (int k = 0; k <= half_cells; ++k) {
        const double energy = k == half_cells ? 0.5 : below((k - half_cells) * width);
        early[k] = energy;
        late[k] = energy - 1.0;
        early[2 * half_cells - k] = 1.0 - energy;
        late[2 * half_cells - k] = -energy;
    }
    table.centre = 0.0;
    table.cell_of_centre = static_cast<float>(half_cells + 1);
    table.cells_per_period = static_cast<float>(1.0 / width);
    build_forward(table, early, late, half_cells);

    auto density = [&](double v) {
        double sum = 0.0;
        for (int k = -reach; k <= reach; ++k) sum += normal_density((v + k) / shape.sigma);
        return sum / shape.sigma;
    };

    // Quantile of the early half on cells of equal relative width, linear inside a cell; of a pulse alone in its frame,
    // that of the normal law.
    const bool alone = reach == 0;
    auto quantile = [&](double p, int32_t cell, double from) {
        if (p >= 0.5) return 0.0;
        return alone ? shape.sigma * normal_quantiles()[cell] : solved(below, density, p, from);
    };
    const int32_t last = octave_cell(0.5f), first = octave_cell(std::ldexp(1.0f, -kOctaves));
    table.inverse.assign(2 * (last + 2), 0.0f);  // p = 1/2 and what rounds to a little more: the centre
    double edge = octave_edge(first), position = quantile(edge, first, std::max(-0.5, -kGaussianReach * shape.sigma));
    for (int32_t cell = 0; cell < first; ++cell) table.inverse[2 * cell] = static_cast<float>(position);
    for (int32_t cell = first; cell < last; ++cell) {
        const double next_edge = octave_edge(cell + 1), next_position = quantile(next_edge, cell + 1, position);
        const double slope = (next_position - position) / (next_edge - edge);
        table.inverse[2 * cell] = static_cast<float>(position - slope * edge);
        table.inverse[2 * cell + 1] = static_cast<float>(slope);
        edge = next_edge;
        position = next_position;
    }
}

// The sample edge nearest the median.
int median_edge(const std::vector<double>& knots) {
    int nearest = 0;
    for (int k = 0; k < static_cast<int>(knots.size()); ++k)
        if (std::fabs(knots[k] - 0.5) < std::fabs(knots[nearest] - 0.5)) nearest = k;
    return nearest;
}

// Every sample as two: the same density.
std::vector<double> halved(const std::vector<double>& knots) {
    std::vector<double> fine;
    fine.reserve(2 * knots.size());
    for (size_t k = 0; k + 1 < knots.size(); ++k) {
        fine.push_back(knots[k]);
        fine.push_back(0.5 * (knots[k] + knots[k + 1]));
    }
    fine.push_back(knots.back());
    return fine;
}

// The tables of a sampled pulse: exact in each sample, where the density is constant.
void build_sampled(PulseTable& table) {
    const PulseShape& shape = table.shape;
    std::vector<double> knots = shape.knots;
    double width = shape.width;
    int split = median_edge(knots);
    if (std::fabs(knots[split] - 0.5) >
        0.25) {  // most of the energy in one sample: both halves need some for their tails
        knots = halved(knots);
        width *= 0.5;
        split = median_edge(knots);
    }
    const int cells = static_cast<int>(knots.size()) - 1;
    const double half = 0.5 * width * cells;
    table.centre = shape.start + half;
    table.cell_of_centre = static_cast<float>(0.5 * cells + 1.0);
    table.cells_per_period = static_cast<float>(1.0 / width);
    std::vector<double> late(knots.size());
    for (size_t k = 0; k < knots.size(); ++k) late[k] = knots[k] - 1.0;
    build_forward(table, knots, late, split);

    // Samples that carry energy, in order of time; `upper` is the energy at the end of each, early samples
    // counted from the start, late ones from the end.
    int32_t early_samples = 0;
    for (int k = 0; k < cells; ++k) {
        const float begin = static_cast<float>(k < split ? knots[k] : late[k]);
        const float end = static_cast<float>(k < split ? knots[k + 1] : late[k + 1]);
        if (!(end > begin)) continue;
        table.upper.push_back(end);
        table.end.push_back(static_cast<float>((k + 1) * width - half));
        table.periods_per_energy.push_back(static_cast<float>(width / (knots[k + 1] - knots[k])));
        if (k < split) early_samples = static_cast<int32_t>(table.upper.size());
    }
    table.last_early = std::max(early_samples - 1, 0);
    table.last_late = static_cast<int32_t>(table.upper.size()) - 1;
    // Guide: the first sample whose end lies above the smallest p of a cell of |p|.
    const int32_t guides = octave_cell(1.0f) + 2;  // |p| up to 1 and what rounds to a little more
    table.guide.resize(2 * guides);
    table.guides = guides;
    for (int32_t cell = 0, k = 0; cell < guides; ++cell) {
        const float least = cell == 0 ? 0.0f : octave_edge(cell);
        while (k < table.last_early && !(table.upper[k] > least)) ++k;
        table.guide[cell] = k;
    }
    for (int32_t cell = guides - 1, k = std::min(early_samples, table.last_late); cell >= 0; --cell) {
        const float least = -octave_edge(cell + 1);
        while (k < table.last_late && !(table.upper[k] > least)) ++k;
        table.guide[guides + cell] = k;
    }
}

}  // namespace

PulseTable PulseTable::gaussian(double sigma) {
    PulseTable table;
    table.shape.sigma = sigma;
    build_gaussian(table);
    return table;
}

PulseTable PulseTable::sampled(std::vector<double> knots, double width, double start) {
    PulseTable table;
    table.shape.knots = std::move(knots);
    table.shape.width = width;
    table.shape.start = start;
    build_sampled(table);
    return table;
}

const PulseShape& shape_of(const PulseTable& table) { return table.shape; }
}  // namespace mars
