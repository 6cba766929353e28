// The likelihood of the bins that hold background only, as a power series in its photons per bin: one pass over the
// histogram, after which the period without a stretch of bins costs no more than the stretch.
// docs/theory_reconstruction.md, section 3, (R10).
#pragma once
#include <array>
#include <vector>

#include "reconstruct/bins.h"
#include "reconstruct/sums.h"

namespace mars {

class BackgroundSeries {
 public:
    // powers of the photons per bin that are kept
    static constexpr int kOrder = kSeriesTerms;
    // Photons per bin up to which the series is used; its radius of convergence is about pi.
    static constexpr double kMost = 0.25;

    using Terms = std::array<double, kOrder>;  // of the powers 1 .. kOrder

    // `all`: the bins of a whole period, from bin 0 on.
    void set(const HistogramRecord& r, const BinRun& all) {
        bins_ = r.bins;
        length_ = static_cast<int64_t>(all.count.size());
        terms_.resize(kOrder * length_);
        bins_kernels().series({all.count.data(), all.armed.data(), all.rearmed.data(), all.shares(), length_,
                               r.below_bin(), terms_.data()});
        sum_ = sum(0, bins_);
    }

    // All bins but `count` of them from `first` on, round the period.
    Terms without(int64_t first, int64_t count) const {
        const int64_t straight = std::min(count, bins_ - first);
        const Terms left = sum(first, straight), right = sum(0, count - straight);
        Terms out;
        for (int k = 0; k < kOrder; ++k) out[k] = sum_[k] - left[k] - right[k];
        return out;
    }

 private:
    Terms sum(int64_t first, int64_t count) const {
        return sums_of<kOrder>(count, [this, first](int64_t j) {
            Terms each;
            for (int k = 0; k < kOrder; ++k) each[k] = terms_[k * length_ + first + j];
            return each;
        });
    }

    int64_t bins_ = 0, length_ = 0;
    BinValues terms_;  // (kOrder, length_)
    Terms sum_{};
};

}  // namespace mars
