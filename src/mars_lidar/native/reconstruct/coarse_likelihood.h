// The likelihood of a histogram from its own registrations, with derivatives, where bins may be wider than the pulse.
//
// A registration blinds its pixel for the dead time, so that the registrations of the preceding dead time give the passes
// in which the pixel is armed at the start of a bin, and those of one dead time earlier the passes that re-arm in it. Both
// need to know where in their bins registrations lie. In a bin of even light they are spread evenly; the bins that
// the pulse reaches, and those one and two dead times later, are cut into cells, and a bin's registrations are distributed
// over its cells as a pixel registers that is armed as the histogram says. Where the passes that re-arm under the
// pulse are themselves registrations of the pulse, that distribution depends on itself, and is iterated.
#pragma once
#include "numbers/jet.h"
#include "reconstruct/coarse_kernel.h"

namespace mars {
inline namespace MARS_LEVEL {

// Energy of the periodic pulse train up to times after the delay, and its two derivatives.
MARS_INLINE void pulse_train(const PulseShape& pulse, const Real& time, Real* values) {
    const Real magic = splat(6755399441055744.0);                    // 1.5 * 2^52: rounds to integers
    const Real whole = (time + magic) - magic, rest = time - whole;  // within half a period of a pulse
    const double below = -pulse.low() - 0.5, above = pulse.high() - 0.5, most = below < above ? above : below;
    const int further = most > 0.0 ? static_cast<int>(std::ceil(most)) : 0;
    values[0] = whole;
    values[1] = values[2] = splat(0.0);
    for (int turn = -further; turn <= further; ++turn) {
        Real alone[3];
        const Real t = rest - static_cast<double>(turn);
        if (pulse.gaussian()) {
            const double scale = 1.0 / pulse.sigma;
            normal_law(t * scale, alone);
            alone[1] = alone[1] * scale;
            alone[2] = alone[2] * (scale * scale);
        } else {
            alone[2] = splat(0.0);
            for (int k = 0; k < kReals; ++k) {
                const double place = (lane(t, k) - pulse.start) / pulse.width;
                const bool inside = place >= 0.0 && place < static_cast<double>(pulse.knots.size() - 1);
                const double* knot = pulse.knots.data() + (inside ? static_cast<int64_t>(place) : 0);
                set_lane(alone[0], k, pulse.cumulative(lane(t, k)));
                set_lane(alone[1], k, inside ? (knot[1] - knot[0]) / pulse.width : 0.0);
            }
        }
        for (int k = 0; k < 3; ++k) values[k] = values[k] + alone[k];
    }
}

// Chances that a pass registers in a bin, or cell, of `light` photons, of which `part` comes first: one armed at its start,
// one re-armed evenly in the rest, one re-armed evenly in the first part.
template <class T>
struct Chances {
    T armed, late, early, quiet;

    Chances() = default;
    Chances(const T& light, double part) {
        const T rest = (1.0 - part) * light, first = part * light, stays = decay(rest), still = decay(first);
        const T fires = fired(rest, stays), starts = fired(first, still);
        late = rearmed(rest, fires);
        early = fires + stays * rearmed(first, starts);
        armed = fires + stays * starts;
        quiet = stays * still;
    }

 private:
    static T fired(const T& x, const T& stays) { return choose(number(x) < 1e-5, x * (1.0 + -0.5 * x), 1.0 - stays); }
    // 1 - (1 - e^-x) / x
    static T rearmed(const T& x, const T& fires) {
        const T series = x * (0.5 - x * (1.0 / 6 - x * (1.0 / 24 - x * (1.0 / 120 - (1.0 / 720) * x))));
        return choose(number(x) < 0.02, series, 1.0 - fires * reciprocal(larger(x, constant<T>(splat(0.01)))));
    }
};

template <class T>
class CoarseLikelihood {
 public:
    explicit CoarseLikelihood(const CoarsePlan& plan)
        : plan_(plan), r_(plan.record), fine_(plan.delay), bins_(r_.bins) {}

    // Logarithm of the likelihood of `counts` (kReals, bins), up to a constant, at this light (3).
    T operator()(const double* const* counts, const Real* light) {
        T signal, background, delay;
        set_variable(signal, light[0], 0);
        set_variable(background, light[1], 1);
        set_variable(delay, light[2], 2);
        read(counts, light[2]);
        flat_ = (1.0 / static_cast<double>(r_.bins)) * background;
        illuminate(signal, delay);
        return r_.dead == 0.0 ? poisson() : passed(background);
    }

 private:
    struct Bin {
        Real counts, before;  // registrations in the bin, and before it in the period
        Real number;          // of the bin, in the period
        T light;              // photons
    };

    int64_t cyclic(int64_t i) const { return i < 0 ? i + r_.bins : i >= r_.bins ? i - r_.bins : i; }
    static int64_t cyclic(int64_t i, int64_t n) { return i < 0 ? i + n : i >= n ? i - n : i; }  // of -n <= i < 2 n

    // Share of registrations within the exposure, of which this many laps ended when the `ready`-th of what follows began.
    Real within(const Real& at, double ready) const {
        return at < ready ? splat(plan_.within[1]) : splat(plan_.within[0]);
    }

    // The bins of the pixels, from the one on in which `low` before the pulse lies.
    void read(const double* const* counts, const Real& delay) {
        const int64_t n = r_.bins;
        all_ = splat(0.0);
        for (int k = 0; k < kReals; ++k) {
            const int64_t first = static_cast<int64_t>(std::floor((lane(delay, k) + r_.low) * static_cast<double>(n)));
            set_lane(first_, k, static_cast<double>(first));
            int64_t i = cyclic(-(first % n), n);  // number of the first bin of the period
            double sum = 0.0;
            for (int64_t j = 0; j < n; ++j) {
                Bin& bin = bins_[i];
                set_lane(bin.counts, k, counts[k][j]);
                set_lane(bin.before, k, sum);
                set_lane(bin.number, k, static_cast<double>(j));
                sum += counts[k][j];
                i = i + 1 == n ? 0 : i + 1;
            }
            set_lane(all_, k, sum);
        }
    }

    // Light of the bins, and of the finest cells of the bins of the pulse.
    void illuminate(const T& signal, const T& delay) {
        const int64_t n = r_.bins, cells = 2 * r_.cells;
        for (int64_t i = 0; i < n; ++i) bins_[i].light = flat_;
        energy_.clear();
        T before = energy_until(plan_.first_lit, 0, 1, delay);
        for (int64_t i = plan_.first_lit; i < plan_.end_lit; ++i) {
            const bool cut = i >= 0 && i < plan_.pulsed;
            const int64_t parts = cut ? cells : 1;
            const T first = before;
            for (int64_t c = 1; c <= parts; ++c) {
                const T after = energy_until(i, c, parts, delay);
                if (cut) energy_.push_back(signal * larger(after - before, T()));
                before = after;
            }
            Bin& bin = bins_[cyclic(i)];
            bin.light = bin.light + signal * larger(before - first, T());
        }
    }
    T energy_until(int64_t bin, int64_t cell, int64_t cells, const T& delay) const {
        const double place = static_cast<double>(bin) + static_cast<double>(cell) / static_cast<double>(cells);
        const T time = (first_ + place) * (1.0 / static_cast<double>(r_.bins)) - delay;
        Real values[3];
        pulse_train(r_.pulse, number(time), values);
        return composed(time, values);
    }

    T poisson() const {
        T sum{};
        for (const Bin& bin : bins_)
            sum = sum + likely(bin.counts, bin.light) - static_cast<double>(r_.cycles) * bin.light;
        return sum;
    }

    // Bins in which the distribution over cells matters are expected with two numbers of cells. The error falls with the
    // square of the cells' width, so that an extrapolation removes it (Richardson, Phil. Trans. A 210, 307, 1911).
    T passed(const T& background) {
        const int64_t n = r_.bins, shift = plan_.delay.shift;
        if (!plan_.cut.empty()) {
            expected_.assign(plan_.cut.size(), T());
            passes_.assign(plan_.cut.size(), T());
            further_.assign(plan_.cut.size(), T());
            distribute(background, false, -1.0 / 3.0);
            distribute(background, true, 4.0 / 3.0);
        }
        T sum{};
        const double part = plan_.delay.part;
        const Chances<T> dark(flat_, part);
        const Real even = splat(part);
        for (int64_t j = 0; j < n; ++j) {
            const int64_t place = plan_.place[j];
            if (place >= 0) {
                sum = sum + term(bins_[j].counts, expected_[place], passes_[place]);
                continue;
            }
            const bool lit = j < plan_.end_lit || j >= plan_.first_lit + n;
            const Chances<T> own = lit ? Chances<T>(bins_[j].light, part) : dark;
            if (plan_.depends[j])
                sum = sum + spread(j, own, further(cyclic(j - shift)), further(cyclic(j - shift - 1)));
            else
                sum = sum + spread(j, own, even, even);
        }
        return sum;
    }

    // Distributes the registrations of the bins that are cut over their cells; `again`: over twice as many. Adds what
    // follows, times a weight.
    void distribute(const T& background, bool again, double weight) {
        const int64_t m = cells_ = r_.cells << again, all = r_.bins * m, count = static_cast<int64_t>(plan_.cut.size());
        fine_ = BinDelay(r_.dead, all);
        const T flat = (1.0 / static_cast<double>(all)) * background;
        chances_.clear();
        for (int64_t i = 0; i < plan_.pulsed * m; ++i)
            chances_.emplace_back((again ? energy_[i] : energy_[2 * i] + energy_[2 * i + 1]) + flat, fine_.part);
        chances_.emplace_back(flat, fine_.part);
        if (again) {  // the distribution over half as many cells to begin with
            coarse_.swap(share_);
            share_.resize(count * m);
            for (int64_t i = 0; i < count * m; i += 2) {
                Real former = splat(0.5);
                if (i < plan_.pulsed * m)
                    former = number(chances_[i].armed) / (number(chances_[i].armed) + number(chances_[i + 1].armed));
                share_[i] = former * coarse_[i / 2];
                share_[i + 1] = (1.0 - former) * coarse_[i / 2];
            }
        } else {
            share_.assign(count * m, constant<T>(splat(1.0 / static_cast<double>(m))));
        }
        sources_.resize(m + 1);
        registered_.resize(m);
        result_.resize(2 * count);
        weights_.resize(2 * count * m);
        source_.resize(count);
        placed_.assign(count, 0);
        bool chained = false;  // whether a bin leads to itself or to one before it
        for (int64_t at = 0; at < count; ++at) {
            const int64_t k = plan_.order[at], j = plan_.cut[k], from = cyclic(j * m - fine_.shift - 1, all);
            source_[k] = {from / m, from % m, unblinded(j)};
            for (const int64_t bin : {source_[k].bin, cyclic(source_[k].bin + 1)})
                chained = chained || (plan_.place[bin] >= 0 && !placed_[plan_.place[bin]]);
            placed_[k] = 1;
            for (int64_t i = 0; i < m; ++i) {  // cells before the end of the dead time: from the period before
                const Real cell = bins_[j].number * static_cast<double>(m) + static_cast<double>(i);
                const double shift = static_cast<double>(fine_.shift);
                weights_[2 * (k * m + i)] = within(cell, shift) * (1.0 - fine_.part);
                weights_[2 * (k * m + i) + 1] = within(cell, shift + 1.0) * fine_.part;
            }
        }
        // A bin is gone through again in the pixels in which the registrations that lead to it have changed since.
        const double settled = r_.tolerance * static_cast<double>(r_.cycles);
        const RealMask all_pixels = splat(0.0) < 1.0;
        moved_.assign(count, all_pixels);
        bool moving = true;
        for (int64_t round = 0; moving && round < (chained ? r_.rounds : 1); ++round) {
            moving = false;
            for (const int64_t k : plan_.order) {
                const RealMask again =
                    round == 0 ? all_pixels : moved(source_[k].bin) | moved(cyclic(source_[k].bin + 1));
                const bool some = any_of(again);
                moved_[k] = some ? again & (pass(k, again) > settled) : again;
                moving = moving || some;
            }
        }
        for (int64_t k = 0; k < count; ++k) {
            expected_[k] = expected_[k] + weight * result_[2 * k];
            passes_[k] = passes_[k] + weight * result_[2 * k + 1];
            further_[k] = further_[k] + weight * beyond(&share_[k * m]);
        }
    }

    RealMask moved(int64_t bin) const {
        const int64_t place = plan_.place[bin];
        return place < 0 ? splat(0.0) > 1.0 : moved_[place];
    }

    // Goes through the cells of the k-th bin that is cut; returns the largest change of registrations of a cell.
    Real pass(int64_t k, const RealMask& active) {
        const int64_t m = cells_, j = plan_.cut[k];
        // Registrations of the cells that re-arm the pixel in the bin, from the one before the first of them on. Those of
        // the first bin are blind at the start of this.
        int64_t bin = source_[k].bin, cell = source_[k].cell;
        T blind{};
        for (int64_t i = 0; i <= m; cell = 0) {
            const int64_t next = m + 1 < i + m - cell ? m + 1 : i + m - cell, place = plan_.place[bin];
            const Real& counts = bins_[bin].counts;
            if (place >= 0) {
                const T* share = &share_[place * m + cell];
                for (int64_t to = i; to < next; ++to) sources_[to] = counts * *share++;
            } else {
                const T each = constant<T>(counts * (1.0 / static_cast<double>(m)));
                for (int64_t to = i; to < next; ++to) sources_[to] = each;
            }
            if (i == 0) {
                blind = fine_.part * sources_[0];
                for (int64_t of = 1; of < next; ++of) blind = blind + sources_[of];
            }
            i = next;
            bin = cyclic(bin + 1);
        }
        T inside{};
        const Real* weights = &weights_[2 * k * m];
        for (int64_t i = 0; i < m; ++i) {
            registered_[i] = weights[2 * i] * sources_[i + 1];
            sources_[i] = weights[2 * i + 1] * sources_[i];
            inside = inside + (registered_[i] + sources_[i]);
        }
        const Real& counts = bins_[j].counts;
        const Real covers = within(bins_[j].number, static_cast<double>(plan_.delay.shift) + 1.0);
        T armed = started(counts, source_[k].passed - covers * blind, inside), sum{};
        const T passes = armed + inside;
        const bool pulsed = k < plan_.pulsed;
        const Chances<T>* chances = &chances_[(pulsed ? k : plan_.pulsed) * m];
        for (int64_t i = 0; i < m; ++i, chances += pulsed) {
            const T &late = registered_[i], &early = sources_[i], fired = late * chances->late + early * chances->early;
            const T quiet = armed * chances->quiet + (late + early - fired);
            registered_[i] = armed * chances->armed + fired;
            sum = sum + registered_[i];
            armed = quiet;
        }
        result_[2 * k] = choose(active, sum, result_[2 * k]);
        result_[2 * k + 1] = choose(active, passes, result_[2 * k + 1]);
        const RealMask moving = active & (number(sum) > 0.0);
        const T scale = reciprocal(choose(moving, sum, constant<T>(splat(1.0))));
        Real change = splat(0.0);
        for (int64_t i = 0; i < m; ++i) {
            T& share = share_[k * m + i];
            const T now = choose(moving, registered_[i] * scale, share);
            change = larger(change, absolute(number(now) - number(share)));
            share = now;
        }
        return counts * change;
    }

    // Share of a bin's registrations that re-arm the pixel in the later of the two bins that the dead time reaches.
    T beyond(const T* share) const {
        const double nearer = (1.0 - plan_.delay.part) * static_cast<double>(cells_);
        T sum{};
        for (int64_t i = cells_ - 1; i >= 0 && static_cast<double>(i + 1) > nearer; --i) {
            const double before = nearer - static_cast<double>(i);
            sum = sum + (before > 0.0 ? 1.0 - before : 1.0) * share[i];
        }
        return sum;
    }
    T further(int64_t bin) const {
        const int64_t place = plan_.place[bin];
        return place < 0 ? constant<T>(splat(plan_.delay.part)) : further_[place];
    }

    // Passes armed at the start of bin j, and those in which a registration of the bin d + 1 bins before is blind there.
    Real unblinded(int64_t j) const {
        const int64_t shift = plan_.delay.shift;
        const Real since = bins_[cyclic(j - shift)].before;
        const auto covered = [&](int64_t wraps) {
            return wraps + plan_.delay.whole == 0 ? -since
                                                  : plan_.sums[wraps] * all_ + plan_.within[wraps] * (all_ - since);
        };
        const Real blind = bins_[j].number < static_cast<double>(shift) ? covered(1) : covered(0);
        return static_cast<double>(r_.cycles) - bins_[j].before - blind;
    }

    // Passes armed at the start of a bin in which `inside` re-arm: no less than what registers.
    template <class U>
    static U started(const Real& count, const U& passed, const U& inside) {
        return larger(passed, larger(count - inside, U{}));
    }

    // Of a bin that is not cut. `further`: of the registrations d bins before, and d + 1.
    template <class U>
    T spread(int64_t j, const Chances<T>& chances, const U& further, const U& further_before) const {
        const int64_t shift = plan_.delay.shift;
        const Bin &bin = bins_[j], &nearer = bins_[cyclic(j - shift)], &farther = bins_[cyclic(j - shift - 1)];
        const double ready = static_cast<double>(shift);
        const U late = (within(bin.number, ready) * nearer.counts) * (1.0 - further);
        const U early = (within(bin.number, ready + 1.0) * farther.counts) * further_before;
        const U inside = late + early, armed = started(bin.counts, U(unblinded(j) - early), inside);
        return term(bin.counts, armed * chances.armed + late * chances.late + early * chances.early, U(armed + inside));
    }

    // Binomial: `count` of the `passes` registered, and `expected` were to.
    template <class U>
    static T term(const Real& count, const T& expected, const U& passes) {
        const U rest = passes - count, none = constant<U>(splat(1.0));
        const RealMask some = number(rest) > 0.0;
        const T quiet = larger(passes - expected, constant<T>(splat(1e-12)));
        return likely(count, expected) +
               choose(some, rest * (natural_log(quiet) - natural_log(choose(some, rest, none))), T());
    }

    // count log(expected), of none 0
    static T likely(const Real& count, const T& expected) {
        const T one = constant<T>(splat(1.0));
        return count * natural_log(choose(count > 0.0, larger(expected, constant<T>(splat(1e-300))), one));
    }

    const CoarsePlan& plan_;
    const CoarseRecord& r_;
    BinDelay fine_;  // of cells
    std::vector<Bin> bins_;
    Real first_, all_;  // number of the first bin in the period; registrations
    T flat_{};          // photons of the background in a bin
    int64_t cells_ = 1;
    struct Source {
        int64_t bin, cell;  // the one that re-arms the pixel in the first cell, early
        Real passed;        // `unblinded`
    };
    std::vector<uint8_t> placed_;
    std::vector<Source> source_;       // of each bin that is cut
    std::vector<Real> weights_;        // of each cell: of registrations of either cell that re-arms in it
    std::vector<T> energy_;            // photons of the pulse in the finest cells that it reaches
    std::vector<Chances<T>> chances_;  // of the cells of the pulse; of one in the dark
    std::vector<T> share_, coarse_;    // of a bin's registrations in each of its cells
    std::vector<T> sources_, registered_;
    std::vector<RealMask> moved_;
    std::vector<T> result_;                       // expected registrations and passes of each bin that is cut
    std::vector<T> expected_, passes_, further_;  // extrapolated
};

}  // namespace MARS_LEVEL
}  // namespace mars
