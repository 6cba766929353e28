// What is known of a pixel whose photons are drawn one by one, and the choices that each of them makes: inside of
// the pulse's frame or outside, proposed where, accepted or not. Shared by the processor's loops
// (mars/shape_photons.h) and those of a GPU (cuda/mars.h).
#pragma once
#include "mars/shape_alignment.h"
#include "numbers/random.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

// The second counter word: far from the rounds, which count from 0.
constexpr uint32_t kShareStep = 0xfffffffdu, kProposeStep = 0xfffffffcu, kFrameStep = 0xfffffffbu;

constexpr int64_t kMostPhotonBins = 4096;  // one word is both bin and acceptance: the bin's share errs by bins x 2^-32
constexpr int64_t kMostPhotons = 65535;    // as many as a counter of 16 bits holds
constexpr double kWorkPerBin = 1.5;        // proposals and photons for each bin, from which on rounds cost less
constexpr int kBlock = 64, kBlocks = 8;    // words of 32 events, used together; blocks of proposals
constexpr int kSlots = 4;                  // counters of what is rejected, so that they do not wait for each other
constexpr int kGuideBits = 8;              // of a word, that name where the inversion begins
// entries of the guide that are written at a time, the next ones included: whole vectors, and no loop over each length
constexpr int kStride = 32;

// How many of the photons lie in the frame, by its share of them. Each of them compares a uniform number with the share
// bit by bit, from the highest on, until the bits differ: those that still agree are as many random bits as there are
// of them. `ones(n)`: how many of the next n random bits are 1.
template <class Ones>
MARS_INLINE int64_t framed_photons(double share, int64_t photons, const Ones& ones) {
    if (share >= 1.0) return photons;
    uint64_t bits = static_cast<uint64_t>(share * 0x1p63) << 1;
    int64_t below = 0;
    for (int64_t agree = photons; agree > 0 && bits; bits <<= 1) {
        const int64_t set = ones(agree);
        if (bits >> 63) {
            below += agree - set;
            agree = set;
        } else {
            agree -= set;
        }
    }
    return below;
}

template <class Team>
class PhotonPlan {
 public:
    PhotonPlan(const ShapeJob& job, Alignment<Team>& alignment, Bump& memory, const Team& team)
        : job_(job),
          alignment_(alignment),
          team_(team),
          n_(job.bins),
          outside_(job.bins - job.frame.size),
          shift_(guide_shift(outside_)) {
        frame_ = memory.take<double>(job.frame.size + 1);
        until_ = memory.take<uint32_t>(job.frame.size + 1);
        low_ = memory.take<float>(kParts + 1);
        high_ = memory.take<float>(kParts + 1);
    }

    static bool serve(const ShapeJob& job) {
        return job.guides && job.shift && job.bins <= kMostPhotonBins && job.frame.cells == 1 && job.frame.size > 0 &&
               job.frame.size < job.bins;
    }

    // Prepares a pixel; false where its shape has to be formed.
    bool set(int64_t pixel) {
        if (!(job_.signal[pixel] + job_.background[pixel] < kBright)) return false;
        const auto move = alignment_.moved_by(pixel);
        part_ = static_cast<float>(move.part);
        mix(pixel);
        share_ = alignment_.set_frame(pixel, move.part, blind_, frame_);
        const float highest = team_.agreed([&] {
            float most = 0.0f;
            for (int s = 0; s < kParts; ++s) most = high_[s] > most ? high_[s] : most;
            return most;
        });
        const double proposed = static_cast<double>(highest) * static_cast<double>(outside_), rest = 1.0 - share_;
        per_photon_ = rest > 1e-6 ? proposed / rest : 1.0;  // rows add up to 1, but for rounding
        if (highest <= 0.0f) share_ = 1.0;
        scale_ = highest > 0.0f ? 1.0f / highest : 0.0f;
        const float scale = scale_;
        float *const low = low_, *const high = high_;
        team_.each(kParts, [=](int64_t s) { low[s] *= scale, high[s] *= scale; });
        begin_ = static_cast<uint32_t>((job_.frame.first + job_.frame.size) % n_);
        offset_ = static_cast<uint32_t>((begin_ + move.whole) % n_);
        first_ = (job_.frame.first + move.whole) % n_;
        invert();
        return true;
    }

    bool pays(int64_t photons) const {
        const double work = static_cast<double>(photons) * (share_ + (1.0 - share_) * per_photon_);
        return photons <= kMostPhotons && work <= kWorkPerBin * static_cast<double>(n_);
    }

    // How many proposals at a time, in blocks, for photons that are left.
    int blocks_for(int64_t left) const {
        const double wanted = static_cast<double>(left) * per_photon_ * (1.0 / kBlock);
        return wanted < 1.0 ? 1 : wanted < kBlocks ? static_cast<int>(wanted) : kBlocks;
    }

    // Proposals of words: their bins; which are rejected, and for which the guide tells.
    struct Proposals {
        Int bin;
        Mask no, told;
    };
    MARS_INLINE Proposals proposals(UInt word) const {
        const uint32_t n = static_cast<uint32_t>(n_);
        UInt column, rest;
        multiply(word, static_cast<uint32_t>(outside_), column, rest);
        const Float v = (to_float(as_int(rest >> 8)) + 0.5f) * 0x1p-24f;
        const Int part = as_int(column >> shift_);
        const Float low = of_thirty_two(low_, part), high = of_thirty_two(high_, part);
        const Mask moves = v < part_ * low, stays = (v >= part_ * high) & (v < low), no = v >= high;
        const UInt bin = as_uint(plus_if(as_int(column + offset_), moves));
        const Mask told = no | moves | stays;
        return {select(bin >= splat(n), as_int(bin - n), as_int(bin)), no, told};
    }

    uint64_t column_of(uint32_t word) const { return static_cast<uint64_t>(word) * static_cast<uint64_t>(outside_); }

    uint32_t bin_of(uint64_t column) const {
        const uint32_t bin = static_cast<uint32_t>(column) + begin_, n = static_cast<uint32_t>(n_);
        return bin >= n ? bin - n : bin;
    }

    // The bin of a proposal that the guide left open, or n where it is rejected. No branch: it would be a coin toss.
    uint32_t decided(uint32_t word) const {
        const uint64_t both = column_of(word);
        const uint32_t column = static_cast<uint32_t>(both >> 32), n = static_cast<uint32_t>(n_);
        const float v = (static_cast<float>(static_cast<uint32_t>(both) >> 8) + 0.5f) * 0x1p-24f;
        float here = 0.0f;
        for (int k = 0; k < used_; ++k) here += weight_[k] * row_[k][bin_of(column)];
        here *= scale_;
        const uint32_t bin = column + offset_ + (v < part_ * here);
        return v < here ? (bin >= n ? bin - n : bin) : n;
    }

 protected:
    // Least and largest values of the mixture in each part.
    void mix(int64_t pixel) {
        float *const low = low_, *const high = high_;
        team_.each(kParts + 1, [=](int64_t s) { low[s] = high[s] = 0.0f; });
        used_ = 0;
        for (int k = 0; k < 4; ++k) {
            const double w = job_.weights[4 * pixel + k];
            if (!(w > 0.0)) continue;
            const int64_t row = job_.rows[4 * pixel + k];
            const RowGuide& guide = job_.guides[row];
            const float weight = static_cast<float>(w);
            const float *const least = guide.low, *const most = guide.high;
            team_.each(kParts + 1, [=](int64_t s) { low[s] += weight * least[s]; });
            team_.each(kParts + 1, [=](int64_t s) { high[s] += weight * most[s]; });
            row_[used_] = job_.shapes + row * n_;
            weight_[used_++] = weight;
        }
        blind_ = static_cast<double>(low_[kParts]);
    }

    // The frame's distribution function.
    void invert() {
        const double scale = share_ > 0.0 ? 0x1p31 / share_ : 0.0;
        last_ = team_.agreed([&] {
            int64_t last = job_.frame.size;
            while (last > 0 && frame_[last] <= 0.0) --last;
            double below = 0.0;
            for (int64_t i = 0; i < last; ++i) {
                below += frame_[i] * scale;
                until_[i] = below < 0x1p31 ? static_cast<uint32_t>(static_cast<int32_t>(below)) : 0x80000000u;
            }
            until_[last] = 0x80000000u;  // words below have 31 bits
            return last;
        });
    }

    const ShapeJob& job_;
    Alignment<Team>& alignment_;
    const Team team_;
    const int64_t n_, outside_;  // bins; of them outside of the frame
    const int shift_;
    double* frame_;       // (size + 1) what each bin of the frame, moved, holds
    uint32_t* until_;     // its distribution function, in units of 2^-31
    float *low_, *high_;  // (32), of the largest value of all
    const float* row_[4];
    float weight_[4];
    int used_ = 0;
    double blind_ = 0.0, share_ = 0.0, per_photon_ = 0.0;  // of the frame; proposals for each photon outside
    float part_ = 0.0f, scale_ = 0.0f;
    uint32_t begin_ = 0, offset_ = 0;  // bin behind the frame; the same, moved
    int64_t first_ = 0, last_ = 0;     // the frame's first bin, moved; its last outcome
};

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
