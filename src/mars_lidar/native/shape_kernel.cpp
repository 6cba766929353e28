// Multinomial histograms at one vector level: Poisson numbers in the bins whose total falls a little short of N, and
// the rest photon by photon.
//
// Independent Poisson numbers of means m pi_j are, given their total M, Multinomial(M, pi); N - M more draws from pi
// make it Multinomial(N, pi), as do M - N of them taken away at random, whatever M was. So the cost is O(bins), not
// O(N), and the law exact.
#include "shape_kernel.h"

#include <cmath>

#include "poisson_lanes.h"
#include "shape_photons.h"

#define MARS_JOIN2(a, b) a##b
#define MARS_JOIN(a, b) MARS_JOIN2(a, b)

namespace mars {
inline namespace MARS_LEVEL {
namespace {

// The second counter word: rounds of Poisson numbers count from 0, these are far out of their reach.
constexpr uint32_t kPlaceStep = 0xffffffffu, kRemoveStep = 0xfffffffeu;

// Photons are placed one by one where there are fewer than this for each bin of 1024: both ways cost the same.
constexpr double kPhotonsPerBin = 0.15;
// Standard deviations by which the total of a round stays short: of one that another follows, of the last.
constexpr double kShort = 4.0, kLastShort = 1.25;

class Sampler {
public:
    Sampler(ShapeBlock& block, Bump& memory)
        : block_(block), job_(*block.job), n_(block.job->bins), padded_(padded_bins(n_)), classes_(shape_classes(n_)) {
        counts_ = memory.take<uint32_t>(padded_);
        until_ = memory.take<float>(padded_);
        below_ = memory.take<double>(classes_);
    }

    // The shape (padded) to draw from.
    void set(const float* shape) {
        shape_ = shape;
        for (int64_t c = 0; c < classes_; ++c) until_[c] = shape[c];
        for (int64_t j = classes_; j < padded_; ++j) until_[j] = until_[j - classes_] + shape[j];
        const float* sums = until_ + padded_ - classes_;
        Float highest = splat(0.0f);
        for (int64_t j = 0; j < padded_; j += kLanes) highest = maximum(highest, load<Float>(shape + j));
        alignas(64) float each[kLanes];
        spill(each, highest);
        highest_ = 0.0f;
        for (int k = 0; k < kLanes; ++k) highest_ = each[k] > highest_ ? each[k] : highest_;
        // eighths side by side, because each sum waits for the one before
        const int64_t eighth = classes_ / 8;
        double within[8] = {};
        for (int64_t c = 0; c < eighth; ++c)
            for (int k = 0; k < 8; ++k) {
                below_[k * eighth + c] = within[k];
                within[k] += static_cast<double>(sums[k * eighth + c]);
            }
        total_ = 0.0;
        for (int k = 0; k < 8; ++k) {
            for (int64_t c = 0; c < eighth; ++c) below_[k * eighth + c] += total_;
            total_ += within[k];
        }
    }

    // One exposure of `photons` registrations into row `row` of the output.
    void draw(int64_t photons, Pair<uint32_t> key, int64_t row) {
        if (photons > 0xffffffffll) {
            block_.full = true;
            return;
        }
        if (photons > 0 && total_ > 0.0)
            scatter(photons, key);
        else
            for (int64_t j = 0; j < padded_; ++j) counts_[j] = 0;
        if (block_.wide)
            write(static_cast<uint32_t*>(block_.out) + row * n_);
        else
            write(static_cast<uint16_t*>(block_.out) + row * n_);
    }

private:
    void scatter(int64_t photons, Pair<uint32_t> key) {
        int64_t left = photons;
        // one by one as long as a photon's search costs less than its share of a round
        const double few = kPhotonsPerBin * 16.0 * static_cast<double>(classes_);
        uint32_t round = 0;
        for (; static_cast<double>(left) > few; ++round) {
            const double wanted = static_cast<double>(left), spread = std::sqrt(wanted);
            const double mean = wanted - (kShort * spread > few ? kShort : kLastShort) * spread;
            if (!(mean > 0.0)) break;
            const double scale = mean / total_;
            if (highest_ * scale >= kLaneMeansBelow)
                add_large_round(scale, key, round);
            else if (round == 0)
                add_round<true>(static_cast<float>(scale), key, round);
            else
                add_round<false>(static_cast<float>(scale), key, round);
            int64_t placed = 0;
            for (int64_t j = 0; j < padded_; j += kShapeStep) placed += block_sum(j);
            left = photons - placed;
        }
        if (round == 0)
            for (int64_t j = 0; j < padded_; ++j) counts_[j] = 0;
        if (left > 0) place(left, key);
        for (int64_t k = 0; left < 0; ++k, ++left) remove(photons - left, key, static_cast<uint32_t>(k));
    }

    // 64 bins take both words of 32 events, so that the width of the lanes does not show.
    template <bool first>
    void add_round(float scale, Pair<uint32_t> key, uint32_t round) {
        constexpr int64_t half = kShapeStep / 2;
        for (int64_t j = 0; j < padded_; j += kShapeStep) {
            for (int64_t k = 0; k < half; k += kLanes) {
                const UInt event = load<UInt>(kLane.value) + static_cast<uint32_t>(j / 2 + k);
                const Pair<UInt> word =
                    threefry<13, UInt>(event, splat(round), splat(key.first), splat(key.second));
                add_lanes<first>(j + k, word.first, scale);
                add_lanes<first>(j + half + k, word.second, scale);
            }
        }
    }

    template <bool first>
    void add_lanes(int64_t bin, UInt word, float scale) {
        const UInt more = as_uint(poisson(word, load<Float>(shape_ + bin) * scale));
        store(counts_ + bin, first ? more : load<UInt>(counts_ + bin) + more);
    }

    void add_large_round(double scale, Pair<uint32_t> key, uint32_t round) {
        const uint64_t whole_key = static_cast<uint64_t>(key.first) << 32 | key.second;
        for (int64_t j = 0; j < padded_; ++j) {
            const double mean = scale * static_cast<double>(shape_[j]);
            const int64_t more = block_.large_poisson(whole_key, static_cast<uint32_t>(j), round, mean);
            counts_[j] = (round == 0 ? 0 : counts_[j]) + static_cast<uint32_t>(more);
        }
    }

    int64_t block_sum(int64_t first) const {
        // counts of one bin may need all 32 bits: two sums of 16
        uint32_t low = 0, high = 0;
        for (int64_t j = first; j < first + kShapeStep; ++j) {
            low += counts_[j] & 0xffffu;
            high += counts_[j] >> 16;
        }
        return static_cast<int64_t>(low) + (static_cast<int64_t>(high) << 16);
    }

    // Photons one by one. The searches of several go side by side, because each waits for memory at every step.
    void place(int64_t photons, Pair<uint32_t> key) {
        alignas(64) uint32_t high[kLanes], low[kLanes];
        double energy[kLanes];
        float rest[kLanes];
        int64_t at[kLanes];
        for (int64_t k = 0; k < photons; k += kLanes) {
            const UInt event = load<UInt>(kLane.value) + static_cast<uint32_t>(k);
            const Pair<UInt> word =
                threefry<13, UInt>(event, splat(kPlaceStep), splat(key.first), splat(key.second));
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
            for (int lane = 0; lane < here; ++lane)
                rest[lane] = static_cast<float>(energy[lane] - below_[at[lane]]);
            for (int64_t size = padded_ / classes_; size > 1; size -= size / 2) {
                const int64_t half = size / 2 * classes_;
                for (int lane = 0; lane < here; ++lane)
                    at[lane] += half & -static_cast<int64_t>(until_[at[lane] + half - classes_] <= rest[lane]);
            }
            for (int lane = 0; lane < here; ++lane) ++counts_[lit(at[lane])];
        }
    }

    // The bin found, or the one before it in its class, or in those before, that rounding led past.
    int64_t lit(int64_t bin) const {
        while (shape_[bin] == 0.0f) bin = bin >= classes_ ? bin - classes_ : (bin > 0 ? bin - 1 : n_ - 1);
        return bin;
    }

    static double uniform53(uint32_t high, uint32_t low) {
        return static_cast<double>(static_cast<int64_t>(static_cast<uint64_t>(high) << 21 | low >> 11)) * 0x1p-53;
    }

    // One of `total` photons, any with equal probability.
    void remove(int64_t total, Pair<uint32_t> key, uint32_t event) {
        const Pair<uint32_t> word = threefry<13, uint32_t>(event, kRemoveStep, key.first, key.second);
        int64_t rest = static_cast<int64_t>(uniform53(word.first, word.second) * static_cast<double>(total));
        int64_t j = 0;
        for (int64_t here; rest >= (here = block_sum(j)); j += kShapeStep) rest -= here;
        while (rest >= static_cast<int64_t>(counts_[j])) rest -= counts_[j++];
        --counts_[j];
    }

    template <class Count>
    void write(Count* to) {
        uint32_t bits = 0;
        for (int64_t j = 0; j < n_; ++j) {
            bits |= counts_[j];
            to[j] = static_cast<Count>(counts_[j]);
        }
        if (sizeof(Count) < 4 && bits > 0xffffu) block_.full = true;
    }

    ShapeBlock& block_;
    const ShapeJob& job_;
    const int64_t n_, padded_, classes_;
    const float* shape_ = nullptr;
    uint32_t* counts_;
    float* until_;   // the shape's sum in a bin's class up to the bin
    double* below_;  // and that of all classes before
    double total_ = 0.0;
    float highest_ = 0.0f;
};

}  // namespace

MARS_NOINLINE void shape_block(ShapeBlock& block) {
    const ShapeJob& job = *block.job;
    Bump memory{static_cast<char*>(block.memory)};
    Alignment alignment(job, memory);
    Sampler sampler(block, memory);
    Photons photons(job, alignment, memory);
    const bool serve = Photons::serve(job);
    for (int64_t p = block.pixel; p < block.pixel + block.pixels; ++p) {
        if (block.aligned) {
            alignment.set(p);
            for (int64_t j = 0; j < job.bins; ++j) block.aligned[p * job.bins + j] = alignment.shape[j];
            continue;
        }
        if (serve && p + 1 < block.pixel + block.pixels) photons.expect(p + 1);
        const bool short_way = serve && photons.set(p);
        bool formed = false;
        for (int64_t r = block.realization; r < block.realization + block.realizations; ++r) {
            if (*block.stop || block.full) return;
            const uint32_t number = job.first_realization + static_cast<uint32_t>(r);
            const Pair<uint32_t> key = stream_key(job.seed ^ kShapeDomain, number, job.pixel_index[p]);
            const int64_t count = job.counts[r * job.pixels + p], at = (r * job.image + job.place[p]) * job.bins;
            if (short_way && photons.pays(count)) {
                if (block.wide)
                    photons.draw(count, key, static_cast<uint32_t*>(block.out) + at);
                else
                    photons.draw(count, key, static_cast<uint16_t*>(block.out) + at);
                continue;
            }
            if (!formed) {
                alignment.set(p);
                sampler.set(alignment.shape);
                formed = true;
            }
            sampler.draw(count, key, r * job.image + job.place[p]);
        }
    }
    Photons::written();
}

}  // namespace MARS_LEVEL

void MARS_JOIN(shape_kernel_, MARS_LEVEL)(ShapeBlock& block) { shape_block(block); }

}  // namespace mars
