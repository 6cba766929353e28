// Multinomial histograms at one vector level: Poisson numbers in the bins whose total falls a little short of N, and
// the rest photon by photon.
//
// Independent Poisson numbers of means m pi_j are, given their total M, Multinomial(M, pi); N - M more draws from pi
// make it Multinomial(N, pi), as do M - N of them taken away at random, whatever M was. So the cost is O(bins), not
// O(N), and the law exact.
#include "shape_kernel.h"

#include <cmath>

#include "poisson_lanes.h"
#include "shape_alignment.h"

#define MARS_JOIN2(a, b) a##b
#define MARS_JOIN(a, b) MARS_JOIN2(a, b)

namespace mars {
inline namespace MARS_LEVEL {
namespace {

// The second counter word: rounds of Poisson numbers count from 0, these are far out of their reach.
constexpr uint32_t kPlaceStep = 0xffffffffu, kRemoveStep = 0xfffffffeu;

// Photons are placed one by one where there are fewer than this for each bin: the cost of both ways is the same.
constexpr double kPhotonsPerBin = 0.1;
// Standard deviations by which the total of a round stays short: of one that another follows, of the last.
constexpr double kShort = 4.0, kLastShort = 1.25;

struct Lanes32 {
    alignas(64) uint32_t value[kLanes];
    constexpr Lanes32() : value() {
        for (int k = 0; k < kLanes; ++k) value[k] = static_cast<uint32_t>(k);
    }
};
constexpr Lanes32 kLane{};

class Sampler {
public:
    Sampler(ShapeBlock& block, Bump& memory)
        : block_(block), job_(*block.job), n_(block.job->bins), padded_(padded_bins(block.job->bins)) {
        counts_ = memory.take<uint32_t>(padded_);
        segment_ = padded_ / kSegments;
        cumulative_ = memory.take<double>(padded_);
    }

    // The shape (padded) to draw from.
    void set(const float* shape) {
        shape_ = shape;
        double sums[kSegments] = {};
        for (int64_t j = 0; j < segment_; ++j)
            for (int s = 0; s < kSegments; ++s)
                cumulative_[s * segment_ + j] = sums[s] += static_cast<double>(shape[s * segment_ + j]);
        Float highest = splat(0.0f);
        for (int64_t j = 0; j < padded_; j += kLanes) highest = maximum(highest, load<Float>(shape + j));
        alignas(64) float each[kLanes];
        spill(each, highest);
        highest_ = 0.0f;
        for (int k = 0; k < kLanes; ++k) highest_ = each[k] > highest_ ? each[k] : highest_;
        start_[0] = 0.0;
        for (int s = 0; s < kSegments; ++s) start_[s + 1] = start_[s] + sums[s];
    }

    // One exposure of `photons` registrations into row `row` of the output.
    void draw(int64_t photons, Pair<uint32_t> key, int64_t row) {
        for (int64_t j = 0; j < padded_; ++j) counts_[j] = 0;
        if (photons > 0) {
            if (photons > 0xffffffffll || !(start_[kSegments] > 0.0)) {
                block_.full = photons > 0xffffffffll;
                return;
            }
            scatter(photons, key);
        }
        if (block_.wide)
            write(static_cast<uint32_t*>(block_.out) + row * n_);
        else
            write(static_cast<uint16_t*>(block_.out) + row * n_);
    }

private:
    void scatter(int64_t photons, Pair<uint32_t> key) {
        int64_t left = photons;
        const double few = kPhotonsPerBin * static_cast<double>(n_);
        for (uint32_t round = 0; static_cast<double>(left) > few; ++round) {
            const double wanted = static_cast<double>(left), spread = std::sqrt(wanted);
            const double mean = wanted - (kShort * spread > few ? kShort : kLastShort) * spread;
            if (!(mean > 0.0)) break;
            const double scale = mean / start_[kSegments];
            if (highest_ * scale < kLaneMeansBelow)
                add_round(static_cast<float>(scale), key, round);
            else
                add_large_round(scale, key, round);
            int64_t total = 0;
            for (int64_t j = 0; j < padded_; j += kShapeStep) total += block_sum(j);
            left = photons - total;
        }
        if (left > 0) place(left, key);
        for (int64_t k = 0; left < 0; ++k, ++left) remove(photons - left, key, static_cast<uint32_t>(k));
    }

    // 64 bins take both words of 32 events, so that the width of the lanes does not show.
    void add_round(float scale, Pair<uint32_t> key, uint32_t round) {
        constexpr int64_t half = kShapeStep / 2;
        for (int64_t j = 0; j < padded_; j += kShapeStep) {
            for (int64_t k = 0; k < half; k += kLanes) {
                const UInt event = load<UInt>(kLane.value) + static_cast<uint32_t>(j / 2 + k);
                const Pair<UInt> word =
                    threefry<13, UInt>(event, splat(round), splat(key.first), splat(key.second));
                add_lanes(j + k, word.first, scale);
                add_lanes(j + half + k, word.second, scale);
            }
        }
    }

    void add_lanes(int64_t bin, UInt word, float scale) {
        const Float mean = load<Float>(shape_ + bin) * scale;
        const Int more = poisson(word, mean);
        store(counts_ + bin, load<UInt>(counts_ + bin) + as_uint(more));
    }

    void add_large_round(double scale, Pair<uint32_t> key, uint32_t round) {
        const uint64_t whole_key = static_cast<uint64_t>(key.first) << 32 | key.second;
        for (int64_t j = 0; j < n_; ++j)
            counts_[j] += static_cast<uint32_t>(block_.large_poisson(whole_key, static_cast<uint32_t>(j), round,
                                                                     scale * static_cast<double>(shape_[j])));
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
        double rest[kLanes];
        const double* at[kLanes];
        for (int64_t k = 0; k < photons; k += kLanes) {
            const UInt event = load<UInt>(kLane.value) + static_cast<uint32_t>(k);
            const Pair<UInt> word =
                threefry<13, UInt>(event, splat(kPlaceStep), splat(key.first), splat(key.second));
            spill(high, word.first);
            spill(low, word.second);
            const int here = photons - k < kLanes ? static_cast<int>(photons - k) : kLanes;
            for (int lane = 0; lane < here; ++lane) {
                const double energy = uniform53(high[lane], low[lane]) * start_[kSegments];
                int64_t s = 0;
                for (int edge = 1; edge < kSegments; ++edge) s += start_[edge] <= energy;
                rest[lane] = energy - start_[s];
                at[lane] = cumulative_ + s * segment_;
            }
            for (int64_t size = segment_; size > 1; size -= size / 2) {
                const int64_t half = size / 2;
                for (int lane = 0; lane < here; ++lane)
                    at[lane] += half & -static_cast<int64_t>(at[lane][half - 1] <= rest[lane]);  // no branch
            }
            for (int lane = 0; lane < here; ++lane) ++counts_[lit(at[lane] - cumulative_)];
        }
    }

    // The bin found, or the one before it that rounding led past.
    int64_t lit(int64_t bin) const {
        while (bin > 0 && (bin >= n_ || shape_[bin] == 0.0f)) --bin;
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
    const int64_t n_, padded_;
    const float* shape_ = nullptr;
    uint32_t* counts_;
    double* cumulative_;  // (kSegments, segment_): inside each
    int64_t segment_;
    double start_[kSegments + 1];
    float highest_ = 0.0f;
};

}  // namespace

MARS_NOINLINE void shape_block(ShapeBlock& block) {
    const ShapeJob& job = *block.job;
    Bump memory{static_cast<char*>(block.memory)};
    Alignment alignment(job, memory);
    Sampler sampler(block, memory);
    for (int64_t p = block.pixel; p < block.pixel + block.pixels; ++p) {
        alignment.set(p);
        sampler.set(alignment.shape);
        for (int64_t r = block.realization; r < block.realization + block.realizations; ++r) {
            if (*block.stop || block.full) return;
            const uint32_t number = job.first_realization + static_cast<uint32_t>(r);
            const Pair<uint32_t> key = stream_key(job.seed ^ kShapeDomain, number, job.pixel_index[p]);
            sampler.draw(job.counts[r * job.pixels + p], key, r * job.image + job.place[p]);
        }
    }
}

}  // namespace MARS_LEVEL

void MARS_JOIN(shape_kernel_, MARS_LEVEL)(ShapeBlock& block) { shape_block(block); }

}  // namespace mars
