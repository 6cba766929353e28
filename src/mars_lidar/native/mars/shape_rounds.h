// Multinomial histograms of many photons: Poisson numbers in the bins whose total falls a little short of N, and the
// rest photon by photon.
//
// Independent Poisson numbers of means m pi_j are, given their total M, Multinomial(M, pi); N - M more draws from pi
// make it Multinomial(N, pi), as do M - N of them taken away at random, whatever M was. So the cost is O(bins), not
// O(N), and the law exact.
#pragma once
#include "mars/shape_alignment.h"
#include "numbers/poisson_lanes.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

// The second counter word: rounds of Poisson numbers count from 0, these are far out of their reach.
constexpr uint32_t kPlaceStep = 0xffffffffu, kRemoveStep = 0xfffffffeu;

// Photons are placed one by one where there are fewer than this for each bin of 1024: both ways cost the same.
constexpr double kPhotonsPerBin = 0.15;
// Standard deviations by which the total of a round stays short: of one that another follows, of the last.
constexpr double kShort = 4.0, kLastShort = 1.25;

// Poisson number of a mean beyond those of the lanes.
using LargePoisson = int64_t (*)(uint64_t key, uint32_t event, uint32_t step, double mean);

template <class Team>
class Rounds {
 public:
    Rounds(const ShapeJob& job, Bump& memory, const Team& team)
        : team_(team), n_(job.bins), padded_(padded_bins(n_)), classes_(shape_classes(n_)) {
        counts = memory.take<uint32_t>(padded_);
        until_ = memory.take<float>(padded_);
        below_ = memory.take<double>(classes_);
        eighths_ = memory.take<double>(9);
        if (!Team::kAlone) {
            sums_ = memory.take<uint32_t>(padded_ / kShapeStep);
            parts_ = memory.take<uint32_t>(padded_ / kPart);
        }
    }

    uint32_t* counts;  // (padded) work area of an exposure

    // The shape (padded) to draw from.
    void set(const float* shape) {
        shape_ = shape;
        const int64_t classes = classes_, eighth = classes / 8;
        float* const until = until_;
        double *const below = below_, *const eighths = eighths_;
        team_.each(classes, [=](int64_t c) { until[c] = shape[c]; });
        team_.columns(padded_ / classes - 1, classes, [=](int64_t row, int64_t c) {
            const int64_t j = (row + 1) * classes + c;
            until[j] = until[j - classes] + shape[j];
        });
        const float* const sums = until + padded_ - classes;
        highest_ = team_.highest(shape, padded_);
        // eighths side by side, because each sum waits for the one before
        team_.columns(eighth, 8, [=](int64_t c, int64_t k) {
            const int64_t at = k * eighth + c;
            below[at] = c > 0 ? below[at - 1] + static_cast<double>(sums[at - 1]) : 0.0;
        });
        total_ = team_.agreed([=] {
            double total = 0.0;
            for (int64_t k = 0; k < 8; ++k) {
                const int64_t last = (k + 1) * eighth - 1;
                eighths[k] = total;
                total += below[last] + static_cast<double>(sums[last]);
            }
            return total;
        });
        team_.each(classes, [=](int64_t c) { below[c] += eighths[c / eighth]; });
    }

    // One exposure of `photons` registrations; false where a bin exceeds the output's type.
    template <class Count>
    bool draw(int64_t photons, Pair<uint32_t> key, Count* to, LargePoisson large) {
        if (photons > 0xffffffffll) return false;
        if (photons > 0 && total_ > 0.0)
            scatter(photons, key, large);
        else
            clear();
        return write(to);
    }

    void clear() const {
        uint32_t* const to = counts;
        team_.each(padded_, [=](int64_t j) { to[j] = 0; });
    }

    // The counters as they are.
    template <class Count>
    bool write(Count* to) const {
        const uint32_t* const from = counts;
        if constexpr (Team::kAlone) {
            uint32_t bits = 0;
            for (int64_t j = 0; j < n_; ++j) {
                bits |= from[j];
                to[j] = static_cast<Count>(from[j]);
            }
            return sizeof(Count) == 4 || bits <= 0xffffu;
        } else {
            constexpr int64_t kMany = 4 / static_cast<int64_t>(sizeof(Count));  // that fill a word
            bool fits = true;
            if (n_ % kMany == 0 && (reinterpret_cast<uint64_t>(to) & 3) == 0)
                team_.each(n_ / kMany, [&](int64_t k) {
                    uint32_t word = from[kMany * k];
                    if constexpr (kMany == 2) {
                        fits = fits && (word | from[2 * k + 1]) <= 0xffffu;
                        word |= from[2 * k + 1] << 16;
                    }
                    reinterpret_cast<uint32_t*>(to)[k] = word;
                });
            else
                team_.each(n_, [&](int64_t j) {
                    fits = fits && (sizeof(Count) == 4 || from[j] <= 0xffffu);
                    to[j] = static_cast<Count>(from[j]);
                });
            return fits;  // of this thread's bins
        }
    }

 private:
    void scatter(int64_t photons, Pair<uint32_t> key, LargePoisson large) {
        int64_t left = photons;
        // one by one as long as a photon's search costs less than its share of a round
        const double few = kPhotonsPerBin * 16.0 * static_cast<double>(classes_);
        uint32_t round = 0;
        for (; static_cast<double>(left) > few; ++round) {
            const double wanted = static_cast<double>(left), spread = std::sqrt(wanted);
            const double mean = wanted - (kShort * spread > few ? kShort : kLastShort) * spread;
            if (!(mean > 0.0)) break;
            const double scale = mean / total_;
            if (highest_ * scale >= kLaneMeansBelow && large)
                add_large_round(scale, key, round, large);
            else if (round == 0)
                add_round<true>(static_cast<float>(scale), key, round);
            else
                add_round<false>(static_cast<float>(scale), key, round);
            left = photons - placed();
        }
        if (round == 0) clear();
        if (left > 0) place(left, key);
        if (left < 0) remove_all(photons, -left, key);
    }

    int64_t placed() const {
        if constexpr (Team::kAlone) {
            int64_t sum = 0;
            for (int64_t j = 0; j < padded_; j += kShapeStep) sum += block_sum(j);
            return sum;
        } else {
            const uint32_t* const from = counts;
            return team_.total(padded_, [=](int64_t j) { return static_cast<int64_t>(from[j]); });
        }
    }

    // 64 bins take both words of 32 events, so that the width of the lanes does not show.
    template <bool first>
    void add_round(float scale, Pair<uint32_t> key, uint32_t round) {
        constexpr int64_t half = kShapeStep / 2;
        team_.lanes(padded_ / 2, [&](int64_t i) {
            const int64_t bin = i / half * kShapeStep + i % half;
            const UInt event = numbered(static_cast<uint32_t>(i));
            const Pair<UInt> word = threefry<13, UInt>(event, splat(round), splat(key.first), splat(key.second));
            add_lanes<first>(bin, word.first, scale);
            add_lanes<first>(bin + half, word.second, scale);
        });
    }

    template <bool first>
    void add_lanes(int64_t bin, UInt word, float scale) {
        const UInt more = as_uint(poisson(word, load<Float>(shape_ + bin) * scale));
        store(counts + bin, first ? more : load<UInt>(counts + bin) + more);
    }

    void add_large_round(double scale, Pair<uint32_t> key, uint32_t round, LargePoisson large) {
        const uint64_t whole_key = static_cast<uint64_t>(key.first) << 32 | key.second;
        for (int64_t j = 0; j < padded_; ++j) {
            const double mean = scale * static_cast<double>(shape_[j]);
            const int64_t more = large(whole_key, static_cast<uint32_t>(j), round, mean);
            counts[j] = (round == 0 ? 0 : counts[j]) + static_cast<uint32_t>(more);
        }
    }

    int64_t block_sum(int64_t first) const {
        // counts of one bin may need all 32 bits: two sums of 16
        uint32_t low = 0, high = 0;
        for (int64_t j = first; j < first + kShapeStep; ++j) {
            low += counts[j] & 0xffffu;
            high += counts[j] >> 16;
        }
        return static_cast<int64_t>(low) + (static_cast<int64_t>(high) << 16);
    }

    // Photons one by one. The searches of several go side by side, because each waits for memory at every step.
    void place(int64_t photons, Pair<uint32_t> key) {
        team_.lanes(photons, [&](int64_t k) {
            alignas(64) uint32_t high[kLanes], low[kLanes];
            double energy[kLanes];
            float rest[kLanes];
            int64_t at[kLanes];
            const UInt event = numbered(static_cast<uint32_t>(k));
            const Pair<UInt> word = threefry<13, UInt>(event, splat(kPlaceStep), splat(key.first), splat(key.second));
            spill(high, word.first);
            spill(low, word.second);
            const int here = photons - k < kLanes ? static_cast<int>(photons - k) : kLanes;
            for (int lane = 0; lane < here; ++lane) {
                energy[lane] = uniform53(high[lane], low[lane]) * total_;
                at[lane] = 0;
            }
            for (int64_t half = classes_ / 2; half > 0; half /= 2)  // the last class that begins below
                for (int lane = 0; lane < here; ++lane)
                    at[lane] += half & -static_cast<int64_t>(below_[at[lane] + half] <= energy[lane]);  // no branch
            for (int lane = 0; lane < here; ++lane) rest[lane] = static_cast<float>(energy[lane] - below_[at[lane]]);
            for (int64_t size = padded_ / classes_; size > 1; size -= size / 2) {
                const int64_t half = size / 2 * classes_;
                for (int lane = 0; lane < here; ++lane)
                    at[lane] += half & -static_cast<int64_t>(until_[at[lane] + half - classes_] <= rest[lane]);
            }
            for (int lane = 0; lane < here; ++lane) team_.increment(counts + lit(at[lane]));
        });
    }

    // The bin found, or the one before it in its class, or in those before, that rounding led past.
    int64_t lit(int64_t bin) const {
        while (shape_[bin] == 0.0f) bin = bin >= classes_ ? bin - classes_ : (bin > 0 ? bin - 1 : n_ - 1);
        return bin;
    }

    static double uniform53(uint32_t high, uint32_t low) {
        return static_cast<double>(static_cast<int64_t>(static_cast<uint64_t>(high) << 21 | low >> 11)) * 0x1p-53;
    }

    // `number` photons fewer than `photons` and these, any with equal probability.
    void remove_all(int64_t photons, int64_t number, Pair<uint32_t> key) {
        if constexpr (Team::kAlone) {
            for (int64_t k = 0; k < number; ++k) {
                int64_t rest = nth(photons + number - k, key, static_cast<uint32_t>(k)), j = 0;
                for (int64_t here; rest >= (here = block_sum(j)); j += kShapeStep) rest -= here;
                while (rest >= static_cast<int64_t>(counts[j])) rest -= counts[j++];
                --counts[j];
            }
        } else {  // one after another, with sums over bins to step by: no bin of a GPU's exposure nears 32 bits
            const auto sum_up = [&](const uint32_t* from, uint32_t* to, int64_t parts, int64_t each) {
                team_.each(parts, [=](int64_t k) {
                    uint32_t sum = 0;
                    for (int64_t j = k * each; j < (k + 1) * each; ++j) sum += from[j];
                    to[k] = sum;
                });
            };
            sum_up(counts, parts_, padded_ / kPart, kPart);
            sum_up(parts_, sums_, padded_ / kShapeStep, kShapeStep / kPart);
            team_.once([&] {
                for (int64_t k = 0; k < number; ++k) {
                    int64_t rest = nth(photons + number - k, key, static_cast<uint32_t>(k)), block = 0;
                    while (rest >= static_cast<int64_t>(sums_[block])) rest -= sums_[block++];
                    int64_t part = block * (kShapeStep / kPart);
                    while (rest >= static_cast<int64_t>(parts_[part])) rest -= parts_[part++];
                    int64_t j = part * kPart;
                    while (rest >= static_cast<int64_t>(counts[j])) rest -= counts[j++];
                    --counts[j];
                    --parts_[part];
                    --sums_[block];
                }
            });
        }
    }

    // Which of `total` photons is removed, in the order of the bins.
    static int64_t nth(int64_t total, Pair<uint32_t> key, uint32_t event) {
        const Pair<uint32_t> word = threefry<13, uint32_t>(event, kRemoveStep, key.first, key.second);
        return static_cast<int64_t>(uniform53(word.first, word.second) * static_cast<double>(total));
    }

    static constexpr int64_t kPart = 8;  // bins of a sum of the second level

    const Team team_;
    const int64_t n_, padded_, classes_;
    const float* shape_ = nullptr;
    float* until_;   // the shape's sum in a bin's class up to the bin
    double* below_;  // and that of all classes before
    double* eighths_;
    uint32_t *sums_ = nullptr, *parts_ = nullptr;  // counts in 64 bins and in 8, to remove by
    double total_ = 0.0;
    float highest_ = 0.0f;
};

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
