// The likelihood of a histogram from its own registrations, with derivatives, where bins may be wider than the pulse.
//
// A registration blinds its pixel for the dead time, so that the registrations of the preceding dead time give the passes
// in which the pixel is armed at the start of a bin, and those of one dead time earlier the passes that re-arm in it. Both
// need to know where in their bins registrations lie. In a bin of even light they are spread evenly; the bins that
// the pulse reaches, and those one and two dead times later, are cut into cells, and a bin's registrations are distributed
// over its cells as a pixel registers that is armed as the histogram says. Where the passes that re-arm under the
// pulse are themselves registrations of the pulse, that distribution depends on itself, and is iterated.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "instrument/pulse.h"
#include "numbers/jet.h"

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

// Energy of the periodic pulse train up to a time after the delay, or its derivative of the given order.
template <int order>
struct PulseTrain {
    static double at(const PulseShape& pulse, double time) {
        const double whole = std::floor(time + 0.5), rest = time - whole;  // within half a period of a pulse
        const int further = static_cast<int>(std::ceil(std::max({0.0, -pulse.low() - 0.5, pulse.high() - 0.5})));
        double sum = order == 0 ? whole : 0.0;
        for (int turn = -further; turn <= further; ++turn) sum += alone(pulse, rest - turn);
        return sum;
    }
    template <class T>
    static Jet<T> at(const PulseShape& pulse, const Jet<T>& time) {
        return chain(time, PulseTrain<order>::at(pulse, time.value), PulseTrain<order + 1>::at(pulse, time.value));
    }

 private:
    static double alone(const PulseShape& pulse, double t) {
        if (!pulse.gaussian()) {
            if (order == 0) return pulse.cumulative(t);
            const double place = (t - pulse.start) / pulse.width;
            if (order == 2 || !(place >= 0.0) || place >= static_cast<double>(pulse.knots.size() - 1)) return 0.0;
            const size_t k = static_cast<size_t>(place);
            return (pulse.knots[k + 1] - pulse.knots[k]) / pulse.width;
        }
        const double x = t / pulse.sigma;
        if (order == 0) return 0.5 * std::erfc(-0.70710678118654752440 * x);
        const double density = 0.39894228040143267794 * std::exp(-0.5 * x * x) / pulse.sigma;
        return order == 1 ? density : -density * x / pulse.sigma;
    }
};

// Chances that a pass registers in a bin, or cell, of `light` photons, of which `part` comes first: one armed at its start,
// one re-armed evenly in the rest, one re-armed evenly in the first part.
template <class T>
struct Chances {
    T armed, late, early, quiet;

    Chances() = default;
    Chances(const T& light, double part) {
        const T rest = (1.0 - part) * light, first = part * light, stays = decay(rest), still = decay(first);
        const T fires = fired(rest, stays);
        late = rearmed(rest, fires);
        early = fires + stays * rearmed(first, fired(first, still));
        armed = fires + stays * fired(first, still);
        quiet = stays * still;
    }

 private:
    static T fired(const T& x, const T& stays) { return number(x) < 1e-5 ? x * (1.0 - 0.5 * x) : 1.0 - stays; }
    // 1 - (1 - e^-x) / x
    static T rearmed(const T& x, const T& fires) {
        if (number(x) >= 0.02) return 1.0 - fires * reciprocal(x);
        return x * (0.5 - x * (1.0 / 6 - x * (1.0 / 24 - x * (1.0 / 120 - (1.0 / 720) * x))));
    }
};

template <class T>
class CoarseLikelihood {
 public:
    explicit CoarseLikelihood(const CoarseRecord& record)
        : r_(record),
          delay_(record.dead, record.bins),
          fine_(delay_),
          before_(record.bins + 1),
          lit_place_(record.bins, -1),
          place_(record.bins, -1),
          affected_(record.bins, 0) {
        for (int k = 0; k < 3; ++k) within_[k] = r_.within(delay_.whole + k);
        for (int k = 0; k < 2; ++k) {
            sums_[k] = 0.0;
            for (int64_t p = 1; p < delay_.whole + k; ++p) sums_[k] += r_.within(p);
        }
    }

    // Logarithm of the likelihood of `counts` (bins), up to a constant: photons per period, and the delay in periods.
    T operator()(const double* counts, const T& signal, const T& background, const T& delay) {
        counts_ = counts;
        const int64_t n = r_.bins;
        for (int64_t j = 0; j < n; ++j) before_[j + 1] = before_[j] + counts[j];
        flat_ = (1.0 / static_cast<double>(n)) * background;
        add_reached(lit_, lit_place_, number(delay), r_.pulse.low(), r_.pulse.high());
        light_.clear();
        for_energies(delay, lit_[0], static_cast<int64_t>(lit_.size()), n,
                     [&](const T& energy) { light_.push_back(signal * energy + flat_); });
        const T sum = r_.dead == 0.0 ? poisson() : passed(signal, background, delay);
        for (const int64_t j : lit_) lit_place_[j] = -1;
        for (const int64_t j : cut_) place_[j] = -1;
        for (const int64_t j : fed_) affected_[j] = 0;
        lit_.clear();
        cut_.clear();
        fed_.clear();
        return sum;
    }

 private:
    static int64_t cyclic(int64_t i, int64_t n) { return i < 0 ? i + n : i >= n ? i - n : i; }  // of -n <= i < 2 n

    static double nearest(double periods) { return periods - std::floor(periods + 0.5); }  // after whole periods

    // Adds the bins from `low` to `high` after a time to a list, of which `place` has the places.
    void add_reached(std::vector<int64_t>& list, std::vector<int64_t>& place, double from, double low, double high) {
        const double n = static_cast<double>(r_.bins);
        const int64_t first = static_cast<int64_t>(std::floor((from + low) * n));
        const int64_t end = std::min(static_cast<int64_t>(std::floor((from + high) * n)) + 1, first + r_.bins);
        int64_t j = (first % r_.bins + r_.bins) % r_.bins;
        for (int64_t i = first; i < end; ++i, j = cyclic(j + 1, r_.bins)) {
            if (place[j] >= 0) continue;
            place[j] = static_cast<int64_t>(list.size());
            list.push_back(j);
        }
    }

    // each(energy) for `count` of `parts` equal parts of the period, from `first` on: energy of the pulse in each.
    template <class Each>
    void for_energies(const T& delay, int64_t first, int64_t count, int64_t parts, const Each& each) const {
        const double n = static_cast<double>(parts);
        T before = PulseTrain<0>::at(r_.pulse, static_cast<double>(first) / n - delay);
        for (int64_t i = 1; i <= count; ++i) {
            const T after = PulseTrain<0>::at(r_.pulse, static_cast<double>(first + i) / n - delay);
            each(larger(after - before, T()));
            before = after;
        }
    }

    T poisson() const {
        T sum{};
        for (int64_t j = 0; j < r_.bins; ++j) {
            const T& light = lit_place_[j] < 0 ? flat_ : light_[lit_place_[j]];
            sum = sum - static_cast<double>(r_.cycles) * light;
            if (counts_[j] > 0.0) sum = sum + counts_[j] * natural_log(larger(light, T(1e-300)));
        }
        return sum;
    }

    // Bins in which the distribution over cells matters are added up with two numbers of cells. The error falls with the
    // square of the cells' width, so that an extrapolation removes it (Richardson, Phil. Trans. A 210, 307, 1911).
    T passed(const T& signal, const T& background, const T& delay) {
        const int64_t n = r_.bins;
        if (r_.cells >
            0) {  // the bins of the pulse, and those where its registrations re-arm the pixel, once and twice
            const double again = r_.dead - std::floor(r_.dead);
            for (int times = 0; times < (r_.cells > 1 ? 3 : 1); ++times) {
                add_reached(cut_, place_, number(delay) + times * again, r_.low, r_.high);
                if (times == 0) pulsed_ = static_cast<int64_t>(cut_.size());
            }
        }
        for (const int64_t j : cut_) {
            for (const int64_t to : {j, cyclic(j + delay_.shift, n), cyclic(j + delay_.shift + 1, n)}) {
                if (!affected_[to]) fed_.push_back(to);
                affected_[to] = 1;
            }
        }
        energy_.clear();
        if (!cut_.empty())
            for_energies(delay, cut_[0] * 2 * r_.cells, pulsed_ * 2 * r_.cells, n * 2 * r_.cells,
                         [&](const T& energy) { energy_.push_back(signal * energy); });
        T sum{};
        const Chances<T> dark(flat_, delay_.part);
        for (int64_t j = 0; j < n; ++j) {
            if (affected_[j]) continue;
            sum = sum + (lit_place_[j] < 0
                             ? even(j, dark, delay_.part, delay_.part)
                             : even(j, Chances<T>(light_[lit_place_[j]], delay_.part), delay_.part, delay_.part));
        }
        for (int level = 0; level < 2 && !cut_.empty(); ++level) {
            distribute(background, level > 0);
            T part{};
            for (const int64_t j : fed_) {
                if (place_[j] >= 0) {
                    part = part + term(counts_[j], expected_[place_[j]], passes_[place_[j]]);
                    continue;
                }
                const T& light = lit_place_[j] < 0 ? flat_ : light_[lit_place_[j]];
                part = part + even(j, Chances<T>(light, delay_.part), further(cyclic(j - delay_.shift, n)),
                                   further(cyclic(j - delay_.shift - 1, n)));
            }
            sum = sum + (level == 0 ? -1.0 / 3.0 : 4.0 / 3.0) * part;
        }
        return sum;
    }

    // Distributes the registrations of the bins that are cut over their cells; `again`: over twice as many.
    void distribute(const T& background, bool again) {
        const int64_t m = cells_ = r_.cells << again, all = r_.bins * m, count = static_cast<int64_t>(cut_.size());
        fine_ = BinDelay(r_.dead, all);
        const T flat = (1.0 / static_cast<double>(all)) * background;
        chances_.clear();
        for (int64_t i = 0; i < pulsed_ * m; ++i)
            chances_.emplace_back((again ? energy_[i] : energy_[2 * i] + energy_[2 * i + 1]) + flat, fine_.part);
        chances_.emplace_back(flat, fine_.part);
        if (again) {  // the distribution over half as many cells to begin with
            coarse_.swap(share_);
            share_.resize(cut_.size() * m);
            for (size_t i = 0; i < share_.size(); ++i) share_[i] = 0.5 * coarse_[i / 2];
        } else {
            share_.assign(cut_.size() * m, T(1.0 / static_cast<double>(m)));
        }
        sources_.resize(m + 1);
        registered_.resize(m);
        expected_.resize(cut_.size());
        passes_.resize(cut_.size());
        source_.resize(cut_.size());
        late_weight_.resize(cut_.size() * m);
        early_weight_.resize(cut_.size() * m);
        bool chained = false;
        for (int64_t k = 0; k < count; ++k) {
            const int64_t first = cut_[k] * m, from = cyclic(first - fine_.shift - 1, all);
            source_[k] = {from / m, from % m, unblinded(cut_[k])};
            chained = chained || place_[source_[k].bin] >= k || place_[cyclic(source_[k].bin + 1, r_.bins)] >= k;
            for (int64_t i = 0; i < m;
                 ++i) {  // cells before the end of the dead time are reached from the period before
                late_weight_[k * m + i] = within_[first + i < fine_.shift] * (1.0 - fine_.part);
                early_weight_[k * m + i] = within_[first + i <= fine_.shift] * fine_.part;
            }
        }
        // against the shift from the pulse to where it is registered again, so that few rounds do
        const double once = nearest(r_.dead), twice = nearest(2.0 * r_.dead);
        const bool backward = (std::fabs(once) < std::fabs(twice) ? once : twice) < 0.0;
        const double settled = r_.tolerance * static_cast<double>(r_.cycles);
        for (int64_t round = 0; round < (chained ? r_.rounds : 1); ++round) {
            double change = 0.0;
            for (int64_t k = 0; k < count; ++k) change = std::max(change, pass(backward ? count - 1 - k : k));
            if (change <= settled) break;
        }
    }

    // Goes through the cells of the k-th bin that is cut; returns the largest change of registrations of a cell.
    double pass(int64_t k) {
        const int64_t m = cells_, j = cut_[k];
        // Registrations of the cells that re-arm the pixel in the bin, from the one before the first of them on. Those of
        // the first bin are blind at the start of this.
        int64_t bin = source_[k].bin, cell = source_[k].cell;
        T blind{};
        for (int64_t i = 0; i <= m; cell = 0) {
            const int64_t next = std::min(m + 1, i + m - cell), place = place_[bin];
            if (place >= 0) {
                const T* share = &share_[place * m + cell];
                for (int64_t to = i; to < next; ++to) sources_[to] = counts_[bin] * *share++;
            } else {
                std::fill(sources_.begin() + i, sources_.begin() + next, T(counts_[bin] / static_cast<double>(m)));
            }
            if (i == 0) {
                blind = fine_.part * sources_[0];
                for (int64_t of = 1; of < next; ++of) blind = blind + sources_[of];
            }
            i = next;
            bin = cyclic(bin + 1, r_.bins);
        }
        T inside{};
        const double *late_weight = &late_weight_[k * m], *early_weight = &early_weight_[k * m];
        for (int64_t i = 0; i < m; ++i) {
            registered_[i] = late_weight[i] * sources_[i + 1];
            sources_[i] = early_weight[i] * sources_[i];
            inside = inside + (registered_[i] + sources_[i]);
        }
        T armed = started(counts_[j], source_[k].passed - within_[j <= delay_.shift] * blind, inside), sum{};
        passes_[k] = armed + inside;
        const bool pulsed = k < pulsed_;
        const Chances<T>* chances = &chances_[(pulsed ? k : pulsed_) * m];
        for (int64_t i = 0; i < m; ++i, chances += pulsed) {
            const T &late = registered_[i], &early = sources_[i], fired = late * chances->late + early * chances->early;
            const T quiet = armed * chances->quiet + (late + early - fired);
            registered_[i] = armed * chances->armed + fired;
            sum = sum + registered_[i];
            armed = quiet;
        }
        expected_[k] = sum;
        if (!(number(sum) > 0.0)) return 0.0;
        double change = 0.0;
        const T scale = reciprocal(sum);
        for (int64_t i = 0; i < m; ++i) {
            const T share = registered_[i] * scale;
            change = std::max(change, std::fabs(number(share) - number(share_[k * m + i])));
            share_[k * m + i] = share;
        }
        return counts_[j] * change;
    }

    // Share of a bin's registrations that re-arm the pixel in the later of the two bins that the dead time reaches.
    T further(int64_t bin) const {
        if (place_[bin] < 0) return T(delay_.part);
        const T* share = &share_[place_[bin] * cells_];
        const double nearer = (1.0 - delay_.part) * static_cast<double>(cells_);
        T sum{};
        for (int64_t i = cells_ - 1; i >= 0 && static_cast<double>(i + 1) > nearer; --i)
            sum = sum + (1.0 - std::max(0.0, nearer - static_cast<double>(i))) * share[i];
        return sum;
    }

    // Passes armed at the start of bin j, and those in which a registration of the bin d + 1 bins before is blind there.
    double unblinded(int64_t j) const {
        const int64_t n = r_.bins, wraps = j < delay_.shift;
        const double since = before_[cyclic(j - delay_.shift, n)];
        const double covered =
            wraps + delay_.whole == 0 ? -since : sums_[wraps] * before_[n] + within_[wraps] * (before_[n] - since);
        return static_cast<double>(r_.cycles) - before_[j] - covered;
    }

    // Passes armed at the start of a bin in which `inside` re-arm: no less than what registers.
    template <class U>
    static U started(double count, const U& passed, const U& inside) {
        return larger(passed, larger(count - inside, U(0.0)));
    }

    // Of a bin that is not cut. `further`: of the registrations d bins before, and d + 1.
    template <class U>
    T even(int64_t j, const Chances<T>& chances, const U& further, const U& further_before) const {
        const int64_t n = r_.bins;
        const U late = (within_[j < delay_.shift] * counts_[cyclic(j - delay_.shift, n)]) * (1.0 - further);
        const U early = (within_[j <= delay_.shift] * counts_[cyclic(j - delay_.shift - 1, n)]) * further_before;
        const U inside = late + early, armed = started(counts_[j], U(unblinded(j) - early), inside);
        return term(counts_[j], armed * chances.armed + late * chances.late + early * chances.early, U(armed + inside));
    }

    // Binomial: `count` of the `passes` registered, and `expected` were to.
    template <class U>
    static T term(double count, const T& expected, const U& passes) {
        const U rest = passes - U(count);
        T sum{};
        if (count > 0.0) sum = count * natural_log(larger(expected, T(1e-300)));
        if (number(rest) > 0.0) sum = sum + rest * natural_log(reciprocal(rest) * larger(passes - expected, T(1e-12)));
        return sum;
    }

    const CoarseRecord& r_;
    BinDelay delay_, fine_;  // of bins, and of cells
    double within_[3], sums_[2];
    const double* counts_ = nullptr;
    std::vector<double> before_;            // registrations before each bin
    T flat_{};                              // photons of the background in a bin
    std::vector<int64_t> lit_, lit_place_;  // bins that light of the pulse reaches; their places, by bin, or -1
    std::vector<T> light_;                  // photons in them
    std::vector<int64_t> cut_, place_;      // bins that are cut, those of the pulse first; their places
    int64_t pulsed_ = 0;
    std::vector<int64_t> fed_;  // bins whose term depends on cells
    std::vector<uint8_t> affected_;
    int64_t cells_ = 1;
    struct Source {
        int64_t bin, cell;  // the one that re-arms the pixel in the first cell, early
        double passed;      // `unblinded`
    };
    std::vector<Source> source_;  // of each bin that is cut
    std::vector<double> late_weight_,
        early_weight_;                 // of each cell: of registrations of either cell that re-arms in it
    std::vector<T> energy_;            // photons of the pulse in the finest cells that it reaches
    std::vector<Chances<T>> chances_;  // of the cells of the pulse; of one in the dark
    std::vector<T> share_, coarse_;    // of a bin's registrations in each of its cells
    std::vector<T> sources_, registered_;
    std::vector<T> expected_, passes_;  // of each bin that is cut
};

}  // namespace mars
