// The bins of one histogram at one vector level: see reconstruct/bins_kernel.h.
#include "reconstruct/bins_kernel.h"

#include "numbers/jet.h"

namespace mars {
namespace {

static_assert(kBinsTogether % kReals == 0, "whole vectors");
constexpr int kParts = static_cast<int>(kBinsTogether) / kReals;
constexpr double kLeast = 1e-150;  // of what is divided by
constexpr double kMost = 340.0;    // photons in a bin, of which the exponential is taken

MARS_INLINE Real reals(const double* from) {
    Real x;
    memcpy(&x, from, sizeof x);
    return x;
}
MARS_INLINE void put(double* to, const Real& x) { memcpy(to, &x, sizeof x); }

constexpr double kMagic = 6755399441055744.0;  // 1.5 * 2^52: the low bits of a sum with it are the rounded integer

// The largest integers below, or of integers perhaps the one before, plus `kMagic`; |x| < 2^50.
MARS_INLINE Real whole_below(const Real& x) { return (x - 0.5) + kMagic; }

// Bin j, or as many from there on as `T` has numbers.
template <class T>
MARS_INLINE void arm(const ArmBlock& of, int64_t j) {
    const auto at = [j](const double* from) {
        T x;
        memcpy(&x, from + j, sizeof x);
        return x;
    };
    const auto put_at = [j](double* to, const T& x) { memcpy(to + j, &x, sizeof x); };
    const T last = at(of.count - of.earlier), zero = T{};
    // registrations of the preceding whole bins of the dead time
    const T blind = at(of.before) + of.blind - of.weight * at(of.before - of.ago) + of.part * last;
    const T inside = of.early * at(of.count - of.ago) + of.late * last, passed = of.periods - blind;
    const T least = at(of.count) - inside, most = passed > least ? passed : least;
    put_at(of.rearmed, inside);
    put_at(of.raw, passed);
    put_at(of.armed, most > 0.0 ? most : zero);
}

// See Pass (reconstruct/armed_passes.h).
struct Passes {
    Real quiet, fired, q, dq, none;

    explicit MARS_INLINE Passes(const Real& photons) {
        quiet = exp_minus(choose(photons < kMost, photons, splat(kMost)));
        fired = choose(photons < 1e-5, photons * (1.0 - 0.5 * photons), 1.0 - quiet);
        const RealMask few = photons < 0.02;
        q = photons * (0.5 - photons * (1.0 / 6 - photons * (1.0 / 24 - photons * (1.0 / 120))));
        dq = 0.5 - photons * (1.0 / 3 - photons * (0.125 - photons * (1.0 / 30)));
        if (any_of(photons >= 0.02)) {
            const Real inverse = 1.0 / larger(photons, splat(0.01)), alone = fired * inverse;
            q = choose(few, q, 1.0 - alone);
            dq = choose(few, dq, (alone - quiet) * inverse);
        }
        none = 1.0 - q;
    }
    // Of columns of `bins`.
    MARS_INLINE Passes(const double* passed, int64_t bins)
        : quiet(reals(passed)),
          fired(reals(passed + bins)),
          q(reals(passed + 2 * bins)),
          dq(reals(passed + 3 * bins)),
          none(1.0 - q) {}
};

struct Term {
    Real value, score, info;
};

MARS_INLINE Term poisson_term(const Real& h, const Real& armed, const Real& l) {
    const Real zero = splat(0.0), photons = larger(l, splat(kLeast)), inverse = 1.0 / photons;
    const RealMask open = armed > 0.0;
    return {choose(open, h * natural_log(photons) - armed * l, zero), choose(open, h * inverse - armed, zero),
            armed * inverse};
}

MARS_INLINE Term passed_term(const Real& h, const Real& armed, const Real& rearmed, const Passes& pass, bool by_time) {
    const Real zero = splat(0.0), one = splat(1.0);
    const Real all = armed + rearmed, time = armed + 0.5 * rearmed, silent_passes = larger(all - h, zero);
    const RealMask open = time > 1e-12;
    const Real passes = choose(open, all, one), armed_time = choose(open, time, one),
               inverse = 1.0 / (passes * armed_time);
    const Real share = inverse * armed_time, unit = by_time ? inverse * passes : share;
    const Real mean = larger(armed * pass.fired + rearmed * pass.q, splat(kLeast));
    const Real slope = armed * pass.quiet + rearmed * pass.dq;
    const Real silent = larger(armed * pass.quiet + rearmed * pass.none, splat(kLeast));
    const Real both = 1.0 / (mean * silent), fires = both * silent, stays = both * mean;
    const Real value =
        h * natural_log(mean * unit) + silent_passes * natural_log(larger(silent * share, splat(kLeast)));
    return {choose(open, value, zero), choose(open, slope * (h * fires - silent_passes * stays), zero),
            choose(open, all * ((slope * fires) * (slope * stays)), zero)};
}

// each(i, p) for the vectors of the bins: i the first bin, p the part of a sum that they belong to.
template <class Each>
MARS_INLINE void for_bins(int64_t bins, const Each& each) {
    for (int64_t i = 0; i < bins; i += kBinsTogether)
        for (int p = 0; p < kParts; ++p) each(i + p * kReals, p);
}

double total(const Real (&parts)[kParts]) {
    double sum = 0.0;
    for (int p = 0; p < kParts; ++p)
        for (int k = 0; k < kReals; ++k) sum += lane(parts[p], k);
    return sum;
}

// `passed`: what becomes of a pass is known.
template <bool poisson, bool passed>
BinSums terms_of(const TermsBlock& of) {
    Real value[kParts] = {}, score[3][kParts] = {}, info[6][kParts] = {};
    for_bins(of.bins, [&](int64_t i, int p) {
        const Real h = reals(of.count + i), armed = reals(of.armed + i);
        const Real share = of.share ? reals(of.share + i) : splat(1.0);
        Real light, s{}, ds{};
        if (of.energy) {
            s = reals(of.energy + i);
            ds = reals(of.slope + i);
        }
        light = of.light ? reals(of.light + i) : of.signal * s + of.flat * share;
        const auto pass = [&] {
            if constexpr (passed)
                return Passes(of.passed + (of.alike ? p * kReals : i), of.alike ? kBinsTogether : of.bins);
            else
                return Passes(light);
        };
        const Term term =
            poisson ? poisson_term(h, armed, light) : passed_term(h, armed, reals(of.rearmed + i), pass(), of.by_time);
        value[p] = value[p] + term.value;
        if (of.score) {
            put(of.score + i, term.score);
            put(of.info + i, term.info);
            return;
        }
        const Real rows[3] = {s, share, ds};
        int place = 0;
        for (int a = 0; a < 3; ++a) {
            score[a][p] = score[a][p] + term.score * rows[a];
            const Real weighted_row = term.info * rows[a];
            for (int b = 0; b <= a; ++b, ++place) info[place][p] = info[place][p] + weighted_row * rows[b];
        }
    });
    BinSums out;
    out.value = total(value);
    for (int a = 0; a < 3; ++a) out.score[a] = total(score[a]);
    for (int a = 0; a < 6; ++a) out.info[a] = total(info[a]);
    return out;
}

}  // namespace

void MARS_JOIN(arm_bins_, MARS_LEVEL)(const ArmBlock& of) {
    int64_t j = 0;
    for (; j + kReals <= of.bins; j += kReals) arm<Real>(of, j);
    for (; j < of.bins; ++j) arm<double>(of, j);
}

void MARS_JOIN(pulse_energy_, MARS_LEVEL)(const EnergyBlock& of) {
    const PulseCurve& curve = of.curve;
    const double inverse = 1.0 / curve.cell, last = static_cast<double>(curve.energy.size() - 1);
    const double *energy = curve.energy.data(), *slope = curve.slope.data();
    for (int64_t i = 0; i < of.points; i += kReals) {
        const Real u = reals(of.energy + i) - curve.low, whole = whole_below(u) - kMagic, x = (u - whole) * inverse;
        const RealMask within = x < last;
        const Real inside = larger(choose(within, x, splat(0.0)), splat(0.0)), shifted = whole_below(inside),
                   knot = shifted - kMagic;
        Real low{}, high{}, left{}, right{};
        uint64_t cells[kReals];
        memcpy(cells, &shifted, sizeof cells);
        for (int k = 0; k < kReals; ++k) {
            const uint64_t cell = cells[k] & 0xffffffff;
            set_lane(low, k, energy[cell]);
            set_lane(high, k, energy[cell + 1]);
            set_lane(left, k, slope[cell]);
            set_lane(right, k, slope[cell + 1]);
        }
        left = left * curve.cell;
        right = right * curve.cell;
        const Real y = inside - knot, z = 1.0 - y, rise = high - low;
        const Real density = (6.0 * y * z * rise + z * (1.0 - 3.0 * y) * left + y * (3.0 * y - 2.0) * right) * inverse;
        const Real below = low + y * y * (3.0 - 2.0 * y) * rise + y * z * (z * left - y * right);
        put(of.energy + i, whole + choose(within, below, splat(1.0)));
        put(of.density + i, choose(within, density, splat(0.0)));
    }
    for (int64_t i = 0; i < of.bins; i += kReals) {
        put(of.energy + i, larger(reals(of.energy + i + of.apart) - reals(of.energy + i), splat(0.0)));
        put(of.density + i, reals(of.density + i) - reals(of.density + i + of.apart));
    }
}

void MARS_JOIN(bin_passes_, MARS_LEVEL)(const PassesBlock& of) {
    for (int64_t i = 0; i < of.bins; i += kReals) {
        const Real share = of.share ? reals(of.share + i) : splat(1.0);
        const Real energy = of.energy ? reals(of.energy + i) : splat(0.0);
        const Passes pass(of.signal * energy + of.flat * share);
        const Real columns[kPassColumns] = {pass.quiet, pass.fired, pass.q, pass.dq};
        for (int k = 0; k < kPassColumns; ++k) put(of.passed + k * of.bins + i, columns[k]);
    }
}

BinSums MARS_JOIN(bin_terms_, MARS_LEVEL)(const TermsBlock& of) {
    if (of.poisson) return terms_of<true, false>(of);
    return of.passed ? terms_of<false, true>(of) : terms_of<false, false>(of);
}

void MARS_JOIN(bin_products_, MARS_LEVEL)(const ProductsBlock& of) {
    double* product = of.products;
    const auto row = [&](int a, int64_t i) { return of.rows[a] ? reals(of.rows[a] + i) : splat(1.0); };
    for (int a = 0; a < of.number; ++a) {
        Real sum[kParts] = {};
        for_bins(of.bins, [&](int64_t i, int p) { sum[p] = sum[p] + reals(of.score + i) * row(a, i); });
        of.sums[a] = total(sum);
        for (int b = 0; b <= a; ++b) {
            Real both[kParts] = {};
            for_bins(of.bins,
                     [&](int64_t i, int p) { both[p] = both[p] + reals(of.info + i) * row(a, i) * row(b, i); });
            *product++ = total(both);
        }
    }
}

void MARS_JOIN(bin_law_, MARS_LEVEL)(const LawBlock& of) {
    const Passes alike(splat(of.flat));
    for (int64_t i = 0; i < of.bins; i += kReals) {
        const Real armed = reals(of.armed + i), rearmed = reals(of.rearmed + i);
        const Real light = of.light ? reals(of.light + i) : splat(of.flat);
        if (of.poisson) {
            put(of.mean + i, light * armed);
            put(of.variance + i, light * armed);
            put(of.slope + i, armed);
            put(of.asymmetry + i, splat(1.0));
            continue;
        }
        const Passes pass = of.light ? Passes(light) : alike;
        const Real mean = armed * pass.fired + rearmed * pass.q, silent = armed * pass.quiet + rearmed * pass.none;
        const Real all = armed + rearmed;
        const Real quiet = choose(all > 0.0, silent / choose(all > 0.0, all, splat(1.0)), splat(0.0));
        put(of.mean + i, mean);
        put(of.slope + i, armed * pass.quiet + rearmed * pass.dq);
        put(of.variance + i, mean * quiet);
        put(of.asymmetry + i, 2.0 * quiet - 1.0);
        put(of.fired + i, pass.fired);
        put(of.late + i, pass.q);
    }
}

TangentSums MARS_JOIN(bin_tangent_, MARS_LEVEL)(const TangentBlock& of) {
    Real sum[5][kParts] = {};
    for_bins(of.bins, [&](int64_t i, int p) {
        const Real g = reals(of.slope + i), fired = reals(of.fired + i);
        const Real weight = 1.0 / larger(reals(of.variance + i), splat(of.least)),
                   residual = reals(of.residual + i) * weight;
        put(of.weight + i, weight);
        put(of.residual + i, residual);
        const Real each[5] = {g * g * weight, g * residual, g * fired * weight, fired * fired * weight,
                              fired * residual};
        for (int k = 0; k < 5; ++k) sum[k][p] = sum[k][p] + each[k];
    });
    return {total(sum[0]), total(sum[1]), total(sum[2]), total(sum[3]), total(sum[4])};
}

ChangeSums MARS_JOIN(bin_change_, MARS_LEVEL)(const ChangeBlock& of) {
    Real sum[4][kParts] = {};
    for_bins(of.bins, [&](int64_t i, int p) {
        const Real fired = reals(of.fired + i);
        const Real change = (reals(of.other_raw + i) - reals(of.raw + i)) * fired +
                            (reals(of.other_rearmed + i) - reals(of.rearmed + i)) * reals(of.late + i);
        const Real weighted_change = change * reals(of.weight + i);
        put(of.change + i, weighted_change);
        const Real each[4] = {reals(of.slope + i) * weighted_change, change * weighted_change,
                              change * reals(of.residual + i), fired * weighted_change};
        for (int k = 0; k < 4; ++k) sum[k][p] = sum[k][p] + each[k];
    });
    return {total(sum[0]), total(sum[1]), total(sum[2]), total(sum[3])};
}

double MARS_JOIN(bin_cubes_, MARS_LEVEL)(const CubesBlock& of) {
    Real sum[kParts] = {};
    for_bins(of.bins, [&](int64_t i, int p) {
        const Real light = of.along[0] * reals(of.share + i) + of.along[1] + of.along[2] * reals(of.moved + i);
        const Real each = reals(of.change + i) -
                          reals(of.weight + i) * (reals(of.slope + i) * light + of.along[3] * reals(of.fired + i));
        sum[p] = sum[p] + each * each * each * (reals(of.variance + i) * reals(of.asymmetry + i));
    });
    return total(sum);
}

// Of log(m / (E l)) for the registrations and log(1 - m / passes) for the others (R9), in l = flat x open share.
void MARS_JOIN(background_series_, MARS_LEVEL)(const SeriesBlock& of) {
    constexpr int kOrder = kSeriesTerms;
    for (int64_t i = 0; i < of.bins; i += kReals) {
        const Real h = reals(of.count + i), a = reals(of.armed + i), b = reals(of.rearmed + i);
        const Real share = of.share ? reals(of.share + i) : splat(1.0), zero = splat(0.0);
        if (of.poisson) {
            for (int k = 0; k < kOrder; ++k) put(of.terms + k * of.bins + i, k == 0 ? -(a * share) : zero);
            continue;
        }
        const Real all = a + b, time = a + 0.5 * b, quiet = larger(all - h, zero);
        const RealMask open = time > 1e-12;
        const Real to_time = 1.0 / choose(open, time, splat(1.0)), to_all = 1.0 / choose(open, all, splat(1.0));
        // u_k of m / (E l) and v_k of 1 - m / passes: a (1 - e^-l) + b (1 - (1 - e^-l) / l), term by term
        Real u[kOrder + 1], v[kOrder + 1];
        double factorial = 1.0, sign = 1.0;
        MARS_UNROLL
        for (int k = 0; k <= kOrder; ++k) {
            const double first = sign / (factorial * (k + 1)), second = first / (k + 2);
            u[k] = to_time * (a * first + b * second);
            v[k] = to_all * (a * (sign / factorial) + b * first);
            factorial *= k + 1;
            sign = -sign;
        }
        // logarithm of a series: n L_n = n u_n - sum_k k L_k u_(n-k)
        Real fired[kOrder + 1], silent[kOrder + 1], power = share;
        MARS_UNROLL
        for (int n = 1; n <= kOrder; ++n) {
            Real x = static_cast<double>(n) * u[n], y = static_cast<double>(n) * v[n];
            MARS_UNROLL
            for (int k = 1; k < n; ++k) {
                x = x - static_cast<double>(k) * (fired[k] * u[n - k]);
                y = y - static_cast<double>(k) * (silent[k] * v[n - k]);
            }
            fired[n] = x * (1.0 / n);
            silent[n] = y * (1.0 / n);
            put(of.terms + (n - 1) * of.bins + i, choose(open, (h * fired[n] + quiet * silent[n]) * power, zero));
            power = power * share;
        }
    }
}

}  // namespace mars
