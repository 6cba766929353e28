// What the lanes of waveforms work on: the items of a block one after the other, and the tables of their pixels.
#pragma once
#include "numbers/random.h"
#include "waveform/kernel.h"
#include "waveform/table.h"

namespace mars {
inline namespace MARS_LEVEL {

constexpr int64_t kFetchAhead = 16384;  // numbers

struct WaveItem {
    int64_t item, place;  // of the job, of the block
    int32_t slot;         // of its pixel's table
    double photons;       // per period
    Pair<uint32_t> key;

    bool dark() const { return !(photons >= 1e-30); }
};

class WaveFeed {
 public:
    explicit WaveFeed(const WaveformBlock& block) : block_(block), job_(*block.job), layout_(job_.samples) {
        fetch_from(0);
    }

    const TableLayout& layout() const { return layout_; }
    int running() const { return running_; }
    bool more() const { return running_ < block_.team && pixel_ < block_.pixels; }

    // The next item, while there are more().
    WaveItem next() {
        const int64_t pixel = block_.first_pixel + pixel_;
        if (realization_ == 0) prepare(pixel);
        const int64_t place = pixel_ * block_.realizations + realization_;
        const int64_t r = block_.first_realization + realization_;
        if (++realization_ == block_.realizations) {
            realization_ = 0;
            ++pixel_;
        }
        const uint32_t realization = job_.first_realization + static_cast<uint32_t>(r);
        return {r * job_.pixels + pixel, place, latest_, photons_,
                stream_key(job_.seed, realization, job_.pixel_index[pixel])};
    }
    // A lane works with a table, or no longer does.
    void take(int32_t slot) {
        ++users_[slot];
        ++running_;
    }
    void give_back(int32_t slot) {
        --users_[slot];
        --running_;
    }

    int32_t edges_of(int32_t slot) const { return slot * static_cast<int32_t>(layout_.edges) + kFirstEdge; }
    int32_t guide_of(int32_t slot) const { return slot * static_cast<int32_t>(layout_.cells); }

    // Asks for the waveforms of the next pixels, a little at a time: the memory then works while the lanes do.
    MARS_INLINE void fetch() {
        constexpr int kLines = 32, kLine = 8;
        if (fetch_ >= fetch_end_) return;
        for (int line = 0; line < kLines; ++line) prefetch<0, 2>(fetch_ + line * kLine);
        fetch_ += kLines * kLine;
    }

 private:
    // The table of the next pixel, in a slot that no lane uses.
    void prepare(int64_t pixel) {
        latest_ = 0;
        while (users_[latest_] > 0) ++latest_;
        photons_ = fill_table(layout_, job_.waveform + pixel * job_.samples, job_.background[pixel],
                              block_.edges + edges_of(latest_), block_.guides + guide_of(latest_));
        fetch_from(pixel_ + 1);
    }

    // Several lanes may end together, so what is asked for runs ahead of the next pixel by kFetchAhead.
    void fetch_from(int64_t pixel) {
        const double* const next = job_.waveform + (block_.first_pixel + pixel) * job_.samples;
        const int64_t left = (block_.pixels - pixel) * job_.samples;
        if (fetch_ < next) fetch_ = next;
        fetch_end_ = next + (left < kFetchAhead ? left : kFetchAhead);
    }

    const WaveformBlock& block_;
    const Job& job_;
    const TableLayout layout_;
    int64_t pixel_ = 0, realization_ = 0;                   // the next item
    const double *fetch_ = nullptr, *fetch_end_ = nullptr;  // of the waveforms, what has not been asked for
    int32_t latest_ = 0;                                    // slot of the latest pixel's table ...
    double photons_ = 0.0;                                  // ... and its photons per period
    int users_[kMostWaveLanes + 1] = {};                    // lanes that use each slot
    int running_ = 0;
};

}  // namespace MARS_LEVEL
}  // namespace mars
