// Photons of a pixel one by one, without its shape: for moderate counts that costs less than the shape itself.
//
// First how many of them lie in the frame, the bins that the pulse reaches: a binomial number. Those are placed by
// inversion; the frame's bins are all known (shape_alignment.h). The others are proposed evenly over the bins outside,
// and accepted by what the mixture holds there: nearly always its least and largest value in a part of the bins
// (RowGuide) decide, and it is formed in that one bin otherwise. So N independent draws from the shape.
#pragma once
#include "lanes/bits.h"
#include "lanes/streaming.h"
#include "mars/photon_plan.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

class Photons : public PhotonPlan<OneThread> {
 public:
    Photons(const ShapeJob& job, Alignment<OneThread>& alignment, Bump& memory)
        : PhotonPlan(job, alignment, memory, OneThread()), first_old_(alignment.first_old()) {
        counts_ = memory.take<uint16_t>(n_ + kSlots);
        framed_ = memory.take<uint16_t>(kSlots * (job.frame.size + 1));
        place_ = memory.take<uint32_t>(kBlock * kBlocks);
        word_ = memory.take<uint32_t>(kBlock * kBlocks);
        for (int64_t j = 0; j < n_ + kSlots; ++j) counts_[j] = 0;
        for (int64_t i = 0; i < kSlots * (job.frame.size + 1); ++i) framed_[i] = 0;
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
        if (!PhotonPlan::set(pixel)) return false;
        guide();
        return true;
    }

    // One exposure of the pixel.
    template <class Count>
    void draw(int64_t photons, Pair<uint32_t> key, Count* out) {
        const int64_t framed = framed_of(photons, key);
        scatter(photons - framed, key);
        place(framed, key);
        write(out);
    }

    // Before other threads may read what `draw` wrote.
    static void written() { finish_streaming(); }

 private:
    // 64 words of 32 events.
    MARS_INLINE static void words(uint32_t event, uint32_t step, Pair<uint32_t> key, uint32_t* to) {
        for (int k = 0; k < kBlock / 2; k += kLanes) {
            const UInt number = numbered(event + static_cast<uint32_t>(k));
            const Pair<UInt> word = threefry<13, UInt>(number, splat(step), splat(key.first), splat(key.second));
            spill(reinterpret_cast<uint32_t (&)[kLanes]>(to[k]), word.first);
            spill(reinterpret_cast<uint32_t (&)[kLanes]>(to[k + kBlock / 2]), word.second);
        }
    }

    int64_t framed_of(int64_t photons, Pair<uint32_t> key) const {
        alignas(64) uint32_t word[kBlock];
        uint32_t event = 0;
        int64_t used = kBlock;
        return framed_photons(share_, photons, [&](int64_t number) {
            int64_t ones = 0;
            for (int64_t left = number; left > 0; left -= 32) {
                if (used == kBlock) {
                    words(event, kShareStep, key, word);
                    event += kBlock / 2;
                    used = 0;
                }
                const uint32_t mask = left < 32 ? (1u << left) - 1 : ~0u;
                ones += popcount(word[used++] & mask);
            }
            return ones;
        });
    }

    // Photons outside of the frame.
    void scatter(int64_t photons, Pair<uint32_t> key) {
        const uint32_t n = static_cast<uint32_t>(n_);
        uint64_t open[kBlocks];
        uint32_t event = 0;
        for (int64_t left = photons; left > 0;) {
            const int blocks = blocks_for(left);
            for (int b = 0; b < blocks; ++b, event += kBlock / 2) left -= propose(event, key, b * kBlock, open[b]);
            for (int b = 0; b < blocks; ++b)
                for (; open[b]; open[b] &= open[b] - 1) {
                    const int at = b * kBlock + lowest_bit(open[b]);
                    place_[at] = decided(word_[at]);
                    left += place_[at] == n;
                }
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
            const UInt number = numbered(event + static_cast<uint32_t>(k));
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
        const Proposals made = proposals(word);
        const UInt slot = (numbered(0u) & static_cast<uint32_t>(kSlots - 1)) + static_cast<uint32_t>(n_);
        store(place_ + at + k, as_uint(select(made.no, as_int(slot), made.bin)));
        store(word_ + at + k, word);
        rejected |= lane_bits(made.no) << k;
        constexpr uint64_t all = (uint64_t{1} << kLanes) - 1;
        open |= (~lane_bits(made.told) & all) << k;
    }

    // For each leading part of a word where in the frame's distribution function to begin.
    void guide() {
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
        int64_t j = stream_counters(counts_, out, n_);
        for (; j < n_; ++j) {
            out[j] = counts_[j];
            counts_[j] = 0;
        }
    }

    const int64_t first_old_;  // bin, a dead time before the frame
    uint16_t* counts_;         // (n + slots) zeros between exposures
    uint16_t* framed_;         // of the frame's bins, zeros between exposures
    uint32_t *place_, *word_;
    uint16_t start_[(1 << kGuideBits) + kStride + 1];
};

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
