// A pixel's shape before its pulse is aligned: up to four rows of the table with their weights, and the plain move of a
// binned shape by part of a bin, in which every bin keeps what lies before the cut and gives the rest to the next.
#pragma once
#include "lanes/team.h"
#include "mars/bump.h"
#include "mars/shape_job.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

// Memory and sums of one pixel's mixture; `Team` deals the loops over bins out to threads (lanes/team.h).
template <class Team>
class Mixture {
 protected:
    Mixture(const ShapeJob& job, Bump& memory, const Team& team) : job_(job), team_(team), n_(job.bins) {
        mixture_ = memory.take<float>(padded_bins(n_) + 32) + 16;  // room for the bins before and behind
        past_ = memory.take<float>(padded_bins(n_) + 16) + 16;
        if (!Team::kAlone) sums_ = memory.take<double>(kSums);
    }

    // What leaves each bin for the next, if its registrations are spread evenly,
    void past_even(float part) {
        const float* const mixture = mixture_;
        float* const past = past_;
        team_.each(n_, [=](int64_t j) { past[j] = part * mixture[j]; });
    }

    // or with the slope of the neighbours (van Leer's monotonised central one, J. Comput. Phys. 23, 1977): where
    // many registrations re-arm at once, bright background registers with a step outside of the frame too.
    void past_sloped(float part) {
        const float half = 0.5f * part * (1.0f - part), *const mixture = mixture_;
        float* const past = past_;
        team_.each(n_, [=](int64_t j) {
            const float up = mixture[j + 1] - mixture[j], down = mixture[j] - mixture[j - 1];
            const float central = 0.5f * (up + down), steep = up < 0.0f ? -up : up, gentle = down < 0.0f ? -down : down;
            const float most = 2.0f * (steep < gentle ? steep : gentle);
            const float limited = central > most ? most : central < -most ? -most : central;
            past[j] = part * mixture[j] + half * (up * down > 0.0f ? limited : 0.0f);
        });
    }

    // `n` bins from `first` on, each with what the bin before it leaves.
    void move(int64_t first, float* to, int64_t n) const {
        const float *mixture = mixture_ + first, *past = past_ + first;
        team_.each(n, [=](int64_t j) { to[j] = (mixture[j] - past[j]) + past[j - 1]; });
    }

    // `count` bins of the mixture from `first` on, round the period.
    void mix_cyclic(int64_t pixel, int64_t first, int64_t count, float* to) const {
        const int64_t here = count < n_ - first ? count : n_ - first;
        mix(pixel, first, here, to);
        if (here < count) mix(pixel, 0, count - here, to + here);
    }

    void copy_cyclic(int64_t first, int64_t count, float* to) const {
        const float* const mixture = mixture_;
        const int64_t n = n_;
        team_.each(count, [=](int64_t i) { to[i] = mixture[first + i < n ? first + i : first + i - n]; });
    }

    // `count` bins of the mixture from `first` on, not beyond the last bin: one row as it is, or all four places at
    // once.
    void mix(int64_t pixel, int64_t first, int64_t count, float* to) const {
        const float* row[4];
        float weight[4];
        int used = 0;
        for (int k = 0; k < 4; ++k) {
            const double w = job_.weights[4 * pixel + k];
            if (!(w > 0.0)) continue;
            row[used] = job_.shapes + job_.rows[4 * pixel + k] * n_ + first;
            weight[used++] = static_cast<float>(w);
        }
        for (; used < 4; ++used) row[used] = row[0], weight[used] = 0.0f;
        const float *a = row[0], *b = row[1], *c = row[2], *d = row[3];
        const float v = weight[0], w = weight[1], x = weight[2], y = weight[3];
        if (w == 0.0f)
            team_.each(count, [=](int64_t j) { to[j] = v * a[j]; });
        else
            team_.each(count, [=](int64_t j) { to[j] = (v * a[j] + w * b[j]) + (x * c[j] + y * d[j]); });
    }

    int64_t wrap(int64_t bin) const {
        bin %= n_;
        return bin < 0 ? bin + n_ : bin;
    }

    // Sum of the mixture over `count` <= bins bins from `first` on, cyclic; sixteen sums side by side.
    double sum(int64_t first, int64_t count) const {
        if constexpr (!Team::kAlone) return shared_sum(first, count);
        double sums[16] = {};
        double total = 0.0;
        while (count > 0) {
            const int64_t here = count < n_ - first ? count : n_ - first;
            const float* from = mixture_ + first;
            int64_t j = 0;
            for (; j + 16 <= here; j += 16)
                for (int k = 0; k < 16; ++k) sums[k] += static_cast<double>(from[j + k]);
            for (; j < here; ++j) total += static_cast<double>(from[j]);
            count -= here;
            first = 0;
        }
        for (int k = 0; k < 16; ++k) total += sums[k];
        return total;
    }

    // The same sums, each by one thread; the last thread has what is left of a row of sixteen.
    double shared_sum(int64_t first, int64_t count) const {
        const int64_t here = count < n_ - first ? count : n_ - first, there = count - here;
        team_.each(kSums, [&](int64_t k) {
            double total = 0.0;
            for (int part = 0; part < 2; ++part) {
                const float* from = mixture_ + (part ? 0 : first);
                const int64_t number = part ? there : here, rows = number / 16 * 16;
                for (int64_t j = k < 16 ? k : rows; j < (k < 16 ? rows : number); j += k < 16 ? 16 : 1)
                    total += static_cast<double>(from[j]);
            }
            sums_[k] = total;
        });
        return team_.agreed([&] {
            double total = sums_[16];
            for (int k = 0; k < 16; ++k) total += sums_[k];
            return total;
        });
    }

    const ShapeJob& job_;
    const Team team_;
    const int64_t n_;
    float *mixture_, *past_;  // (-1 .. bins]; what leaves each bin for the next

 private:
    static constexpr int64_t kSums = 17;  // sixteen side by side, and the rest
    double* sums_ = nullptr;
};

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
