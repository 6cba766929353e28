// Photons of a pixel one by one, without its shape: for moderate counts that costs less than the shape itself.
//
// First how many of them lie in the frame, the bins that the pulse reaches: a binomial number. Those are placed by
// inversion; the frame's bins are all known (shape_alignment.h). The others are proposed evenly over the bins outside,
// and accepted by what the mixture holds there: nearly always its least and largest value in a part of the bins
// (RowGuide) decide, and it is formed in that one bin otherwise. So N independent draws from the shape.
#pragma once
#include "random.h"
#include "shape_alignment.h"

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
constexpr int kStride = 32;

#if defined(_MSC_VER)
inline int popcount(uint64_t x) {
    int n = 0;
    for (; x; x &= x - 1) ++n;
    return n;
}
inline int lowest_bit(uint64_t x) { return popcount(~x & (x - 1)); }
MARS_INLINE void prefetch(const void*) {}
#else
MARS_INLINE int popcount(uint64_t x) { return __builtin_popcountll(x); }
MARS_INLINE int lowest_bit(uint64_t x) { return __builtin_ctzll(x); }
MARS_INLINE void prefetch(const void* at) { __builtin_prefetch(at); }
#endif

struct Lanes32 {
    alignas(64) uint32_t value[kLanes];
    constexpr Lanes32() : value() {
        for (int k = 0; k < kLanes; ++k) value[k] = static_cast<uint32_t>(k);
    }
};
constexpr Lanes32 kLane{};

class Photons {
public:
    Photons(const ShapeJob& job, Alignment& alignment, Bump& memory)
        : job_(job), alignment_(alignment), n_(job.bins), outside_(job.bins - job.frame.size),
          shift_(guide_shift(outside_)), first_old_(alignment.first_old()) {
        counts_ = memory.take<uint16_t>(n_ + kSlots);
        frame_ = memory.take<double>(job.frame.size + 1);
        until_ = memory.take<uint32_t>(job.frame.size + 1);
        framed_ = memory.take<uint16_t>(kSlots * (job.frame.size + 1));
        place_ = memory.take<uint32_t>(kBlock * kBlocks);
        word_ = memory.take<uint32_t>(kBlock * kBlocks);
        low_ = memory.take<float>(kParts + 1);
        high_ = memory.take<float>(kParts + 1);
        for (int64_t j = 0; j < n_ + kSlots; ++j) counts_[j] = 0;
        for (int64_t i = 0; i < kSlots * (job.frame.size + 1); ++i) framed_[i] = 0;
    }

    static bool serve(const ShapeJob& job) {
        return job.guides && job.shift && job.bins <= kMostPhotonBins && job.frame.cells == 1 && job.frame.size > 0 &&
               job.frame.size < job.bins;
    }

    // Calls for the memory that `set` will read.
    void expect(int64_t pixel) const {
        const PulseFrame& frame = job_.frame;
        for (int k = 0; k < 4; ++k) {
            if (!(job_.weights[4 * pixel + k] > 0.0)) continue;
            const int64_t row = job_.rows[4 * pixel + k];
            const float* shape = job_.shapes + row * n_;
            const char* guide = reinterpret_cast<const char*>(job_.guides + row);
            for (size_t at = 0; at < sizeof(RowGuide); at += 64) prefetch(guide + at);
            for (int64_t j = 0; j < frame.size + 16; j += 16) prefetch(shape + frame.first + j);
            for (int64_t j = 0; j < frame.size + 17; j += 16) prefetch(shape + first_old_ + j);
        }
    }

    // Prepares a pixel; false where its shape has to be formed.
    bool set(int64_t pixel) {
        if (!(job_.signal[pixel] + job_.background[pixel] < kBright)) return false;
        const Alignment::Move move = alignment_.moved_by(pixel);
        part_ = static_cast<float>(move.part);
        mix(pixel);
        share_ = alignment_.set_frame(pixel, move.part, blind_, frame_);
        float highest = 0.0f;
        for (int s = 0; s < kParts; ++s) highest = high_[s] > highest ? high_[s] : highest;
        const double proposed = static_cast<double>(highest) * static_cast<double>(outside_), rest = 1.0 - share_;
        per_photon_ = rest > 1e-6 ? proposed / rest : 1.0;  // rows add up to 1, but for rounding
        if (highest <= 0.0f) share_ = 1.0;
        scale_ = highest > 0.0f ? 1.0f / highest : 0.0f;
        for (int s = 0; s < kParts; ++s) low_[s] *= scale_, high_[s] *= scale_;
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

    // One exposure of the pixel.
    template <class Count>
    void draw(int64_t photons, Pair<uint32_t> key, Count* out) {
        const int64_t framed = binomial(photons, key);
        scatter(photons - framed, key);
        place(framed, key);
        write(out);
    }

    // Before other threads may read what `draw` wrote.
    static void written() {
#if defined(MARS_X86)
        _mm_sfence();
#endif
    }

private:
    // Least and largest values of the mixture in each part.
    void mix(int64_t pixel) {
        for (int s = 0; s <= kParts; ++s) low_[s] = high_[s] = 0.0f;
        used_ = 0;
        for (int k = 0; k < 4; ++k) {
            const double w = job_.weights[4 * pixel + k];
            if (!(w > 0.0)) continue;
            const int64_t row = job_.rows[4 * pixel + k];
            const RowGuide& guide = job_.guides[row];
            const float weight = static_cast<float>(w);
            for (int s = 0; s <= kParts; ++s) low_[s] += weight * guide.low[s];
            for (int s = 0; s <= kParts; ++s) high_[s] += weight * guide.high[s];
            row_[used_] = job_.shapes + row * n_;
            weight_[used_++] = weight;
        }
        blind_ = static_cast<double>(low_[kParts]);
    }

    // 64 words of 32 events.
    MARS_INLINE static void words(uint32_t event, uint32_t step, Pair<uint32_t> key, uint32_t* to) {
        for (int k = 0; k < kBlock / 2; k += kLanes) {
            const UInt number = load<UInt>(kLane.value) + (event + static_cast<uint32_t>(k));
            const Pair<UInt> word = threefry<13, UInt>(number, splat(step), splat(key.first), splat(key.second));
            spill(reinterpret_cast<uint32_t(&)[kLanes]>(to[k]), word.first);
            spill(reinterpret_cast<uint32_t(&)[kLanes]>(to[k + kBlock / 2]), word.second);
        }
    }

    // How many of the photons lie in the frame. Each of them compares a uniform number with the share bit by bit, from
    // the highest on, until the bits differ: those that still agree are as many random bits as there are of them.
    int64_t binomial(int64_t photons, Pair<uint32_t> key) {
        if (share_ >= 1.0) return photons;
        alignas(64) uint32_t word[kBlock];
        uint64_t bits = static_cast<uint64_t>(share_ * 0x1p63) << 1;
        uint32_t event = 0;
        int64_t below = 0, used = kBlock;
        for (int64_t agree = photons; agree > 0 && bits; bits <<= 1) {
            int64_t ones = 0;
            for (int64_t left = agree; left > 0; left -= 32) {
                if (used == kBlock) {
                    words(event, kShareStep, key, word);
                    event += kBlock / 2;
                    used = 0;
                }
                const uint32_t mask = left < 32 ? (1u << left) - 1 : ~0u;
                ones += popcount(word[used++] & mask);
            }
            if (bits >> 63) {
                below += agree - ones;
                agree = ones;
            } else {
                agree -= ones;
            }
        }
        return below;
    }

    // Photons outside of the frame.
    void scatter(int64_t photons, Pair<uint32_t> key) {
        const uint32_t n = static_cast<uint32_t>(n_);
        uint64_t open[kBlocks];
        uint32_t event = 0;
        for (int64_t left = photons; left > 0;) {
            const double wanted = static_cast<double>(left) * per_photon_ * (1.0 / kBlock);
            const int blocks = wanted < 1.0 ? 1 : wanted < kBlocks ? static_cast<int>(wanted) : kBlocks;
            for (int b = 0; b < blocks; ++b, event += kBlock / 2) left -= propose(event, key, b * kBlock, open[b]);
            for (int b = 0; b < blocks; ++b)
                for (; open[b]; open[b] &= open[b] - 1) left += !decide(b * kBlock + lowest_bit(open[b]));
            for (int k = 0; k < blocks * kBlock; ++k) ++counts_[place_[k]];
            for (int k = blocks * kBlock - 1; left < 0; --k) {  // the last ones were too many
                --counts_[place_[k]];
                left += place_[k] < n;
            }
        }
        for (int k = 0; k < kSlots; ++k) counts_[n + k] = 0;
    }

    // A block of proposals into `place_` from `at` on: bins, or counters of what is rejected. Returns how many are
    // accepted, with those that the guide leaves open.
    int64_t propose(uint32_t event, Pair<uint32_t> key, int at, uint64_t& open) {
        uint64_t rejected = 0;
        open = 0;
        for (int k = 0; k < kBlock / 2; k += kLanes) {
            const UInt number = load<UInt>(kLane.value) + (event + static_cast<uint32_t>(k));
            const Pair<UInt> word =
                threefry<13, UInt>(number, splat(kProposeStep), splat(key.first), splat(key.second));
            propose_lanes(word.first, at, k, rejected, open);
            propose_lanes(word.second, at, k + kBlock / 2, rejected, open);
        }
        for (uint64_t rest = open; rest; rest &= rest - 1) {
            const uint32_t bin = bin_of(column_of(word_[at + lowest_bit(rest)]) >> 32);
            for (int k = 0; k < used_; ++k) prefetch(row_[k] + bin);
        }
        return kBlock - popcount(rejected);
    }

    MARS_INLINE void propose_lanes(UInt word, int at, int k, uint64_t& rejected, uint64_t& open) {
        const uint32_t n = static_cast<uint32_t>(n_);
        UInt column, rest;
        multiply(word, static_cast<uint32_t>(outside_), column, rest);
        const Float v = (to_float(as_int(rest >> 8)) + 0.5f) * 0x1p-24f;
        const Int part = as_int(column >> shift_);
        const Float low = of_thirty_two(low_, part), high = of_thirty_two(high_, part);
        const Mask moves = v < part_ * low, stays = (v >= part_ * high) & (v < low), no = v >= high;
        const UInt bin = as_uint(plus_if(as_int(column + offset_), moves));
        const Int place = select(bin >= splat(n), as_int(bin - n), as_int(bin));
        const UInt slot = (load<UInt>(kLane.value) & static_cast<uint32_t>(kSlots - 1)) + n;
        store(place_ + at + k, as_uint(select(no, as_int(slot), place)));
        store(word_ + at + k, word);
        constexpr uint64_t all = (uint64_t{1} << kLanes) - 1;
        const uint64_t away = lane_bits(no);
        rejected |= away << k;
        open |= (~(away | lane_bits(moves | stays)) & all) << k;
    }

    uint64_t column_of(uint32_t word) const { return static_cast<uint64_t>(word) * static_cast<uint64_t>(outside_); }

    uint32_t bin_of(uint64_t column) const {
        const uint32_t bin = static_cast<uint32_t>(column) + begin_, n = static_cast<uint32_t>(n_);
        return bin >= n ? bin - n : bin;
    }

    // A proposal that the guide left open: whether it is accepted, and where. No branch: it would be a coin toss.
    bool decide(int at) {
        const uint64_t both = column_of(word_[at]);
        const uint32_t column = static_cast<uint32_t>(both >> 32), n = static_cast<uint32_t>(n_);
        const float v = (static_cast<float>(static_cast<uint32_t>(both) >> 8) + 0.5f) * 0x1p-24f;
        float here = 0.0f;
        for (int k = 0; k < used_; ++k) here += weight_[k] * row_[k][bin_of(column)];
        here *= scale_;
        const uint32_t bin = column + offset_ + (v < part_ * here);
        place_[at] = v < here ? (bin >= n ? bin - n : bin) : n;
        return v < here;
    }

    // The frame's distribution function, and for each leading part of a word where in it to begin.
    void invert() {
        const int64_t size = job_.frame.size + 1;
        last_ = size - 1;
        while (last_ > 0 && frame_[last_] <= 0.0) --last_;
        const double scale = share_ > 0.0 ? 0x1p31 / share_ : 0.0;
        double below = 0.0;
        for (int64_t i = 0; i < last_; ++i) {
            below += frame_[i] * scale;
            until_[i] = below < 0x1p31 ? static_cast<uint32_t>(static_cast<int32_t>(below)) : 0x80000000u;
        }
        until_[last_] = 0x80000000u;  // words below have 31 bits
        int64_t from = 0;
        for (int64_t i = 0; i <= last_; ++i) {  // in strides: what is too much is overwritten by the next
            const int64_t until = (until_[i] >> (31 - kGuideBits)) + 1;
            for (int64_t b = from; b < until; b += kStride)
                for (int64_t k = 0; k < kStride; ++k) start_[b + k] = static_cast<uint16_t>(i);
            from = until;
        }
    }

    // Photons of the frame.
    void place(int64_t photons, Pair<uint32_t> key) {
        alignas(64) uint32_t word[kBlock];
        const uint32_t* const until = until_;
        uint16_t* const framed = framed_;
        uint32_t event = 0;
        for (int64_t done = 0; done < photons; done += kBlock, event += kBlock / 2) {
            words(event, kFrameStep, key, word);
            const int here = photons - done < kBlock ? static_cast<int>(photons - done) : kBlock;
            for (int k = 0; k < here; ++k) {
                const uint32_t u = word[k] >> 1;
                uint32_t i = start_[u >> (31 - kGuideBits)];
                i += until[i] <= u;
                while (until[i] <= u) ++i;
                ++framed[kSlots * i + (k & (kSlots - 1))];
            }
        }
        for (int64_t i = 0, bin = first_; i <= job_.frame.size; ++i) {
            uint16_t* slot = framed + kSlots * i;
            counts_[bin] = static_cast<uint16_t>(counts_[bin] + ((slot[0] + slot[1]) + (slot[2] + slot[3])));
            for (int k = 0; k < kSlots; ++k) slot[k] = 0;
            if (++bin == n_) bin = 0;
        }
    }

    // The counters, cleared behind.
    void write(uint32_t* out) {
        for (int64_t j = 0; j < n_; ++j) out[j] = counts_[j];
        for (int64_t j = 0; j < n_; ++j) counts_[j] = 0;
    }
    void write(uint16_t* out) {
        int64_t j = 0;
#if defined(MARS_X86)
        if (reinterpret_cast<uintptr_t>(out) % 16 == 0)  // past the cache: nobody reads it before all of it is done
            for (; j + 32 <= n_; j += 32) {
                __m128i* from = reinterpret_cast<__m128i*>(counts_ + j);
                __m128i* to = reinterpret_cast<__m128i*>(out + j);
                for (int k = 0; k < 4; ++k) _mm_stream_si128(to + k, from[k]);
                for (int k = 0; k < 4; ++k) from[k] = _mm_setzero_si128();
            }
#endif
        for (; j < n_; ++j) {
            out[j] = counts_[j];
            counts_[j] = 0;
        }
    }

    const ShapeJob& job_;
    Alignment& alignment_;
    const int64_t n_, outside_;  // bins; of them outside of the frame
    const int shift_;
    const int64_t first_old_;    // bin, a dead time before the frame
    uint16_t* counts_;           // (n + slots) zeros between exposures
    double* frame_;              // (size + 1) what each bin of the frame, moved, holds
    uint32_t* until_;            // its distribution function, in units of 2^-31
    uint16_t* framed_;           // and counters, zeros between exposures
    uint32_t *place_, *word_;
    float *low_, *high_;         // (32), of the largest value of all
    const float* row_[4];
    float weight_[4];
    int used_ = 0;
    double blind_ = 0.0, share_ = 0.0, per_photon_ = 0.0;  // of the frame; proposals for each photon outside
    float part_ = 0.0f, scale_ = 0.0f;
    uint32_t begin_ = 0, offset_ = 0;  // bin behind the frame; the same, moved
    int64_t first_ = 0, last_ = 0;     // the frame's first bin, moved; its last outcome
    uint16_t start_[(1 << kGuideBits) + kStride + 1];
};

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
