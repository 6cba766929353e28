// Correlation of a histogram with a short template, points side by side in the lanes.
#include "reconstruct/correlation_kernel.h"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "lanes/doubles.h"
#include "reconstruct/sums.h"

namespace mars {
namespace {

constexpr double kSmallAngle = 0.05;  // 1 - cosine up to which the series has the angle to 1e-9

// arccos(1 - u) / sqrt(2 u).
MARS_INLINE double angle_series(double u) {
    return 1.0 + u * (1.0 / 12 + u * (3.0 / 160 + u * (5.0 / 896 + u * 35.0 / 18432)));
}

}  // namespace

void MARS_JOIN(correlate_, MARS_LEVEL)(const Correlation& of) {
    static_assert(kCorrelatedTogether % (2 * kLanes) == 0, "whole vectors");
    for (int64_t g = 0; g < of.points; g += 2 * kLanes) {
        Float first = splat(0.0f), second = splat(0.0f);  // sums that do not wait for each other
        for (int64_t q = 0; q < of.step; ++q) {
            const float* from = of.rows + q * of.length + g;
            for (int64_t i = q; i < of.taps; i += of.step, ++from) {
                first = first + load<Float>(from) * of.weights[i];
                second = second + load<Float>(from + kLanes) * of.weights[i];
            }
        }
        store(of.out + g, first);
        store(of.out + g + kLanes, second);
    }
}

int64_t MARS_JOIN(strongest_, MARS_LEVEL)(const WeakPulses& of) {
    Float top = splat(-HUGE_VALF);
    for (int64_t g = 0; g < of.points; g += kLanes) {
        const Float expected = load<Float>(of.expected + g) * of.flat;
        const Float ratio = (load<Float>(of.score + g) - expected) / square_root(maximum(expected, splat(1e-6f)));
        store(of.ratio + g, ratio);
        if (g + kLanes <= of.points) top = maximum(ratio, top);
    }
    float best = -HUGE_VALF;
    for (int64_t g = of.points / kLanes * kLanes; g < of.points; ++g) best = of.ratio[g] > best ? of.ratio[g] : best;
    float each[kLanes];
    store(each, top);
    for (const float x : each) best = x > best ? x : best;
    for (int64_t g = 0; g < of.points; ++g)
        if (of.ratio[g] == best) return g;
    return 0;
}

int MARS_JOIN(hills_, MARS_LEVEL)(const Hills& of) {
    float* const gain = of.gain;
    for (int64_t g = 0; g < of.points; g += kLanes)
        store(gain + g, load<Float>(of.score + g) - load<Float>(of.expected + g) * of.signal);
    gain[-1] = gain[of.points - 1];
    gain[of.points] = gain[0];
    int number = 0;
    float least = -HUGE_VALF;  // above which a place is one of the best
    for (int64_t first = 0; first < of.points; first += kLanes) {
        const Float here = load<Float>(gain + first);
        const Mask hill =
            (here >= load<Float>(gain + first - 1)) & (here > load<Float>(gain + first + 1)) & (here > least);
        if (of.points > 2 && !any(hill)) continue;
        for (int64_t g = first; g < first + kLanes && g < of.points; ++g) {
            const float its = gain[g];
            if (of.points > 2 && (its < gain[g - 1] || its <= gain[g + 1])) continue;
            int place = number < of.most ? number++ : of.most;
            while (place > 0 && gain[of.places[place - 1]] < its) {
                if (place < of.most) of.places[place] = of.places[place - 1];
                --place;
            }
            if (place < of.most) of.places[place] = g;
            if (number == of.most) least = gain[of.places[of.most - 1]];
        }
    }
    return number;
}

void MARS_JOIN(correlate_finely_, MARS_LEVEL)(const FineCorrelation& of) {
#if MARS_WIDE > 1
    using Part = Doubles;
#else
    using Part = double;
#endif
    constexpr int64_t wide = MARS_WIDE, parts = 4;  // sums that do not wait for each other
    static_assert(kCorrelatedTogether % (parts * wide) == 0, "whole vectors");
    for (int64_t g = 0; g < of.points; g += parts * wide) {
        Part sum[parts] = {};
        for (int64_t q = 0; q < of.step; ++q) {
            const double* from = of.rows + q * of.length + g;
            for (int64_t i = q; i < of.taps; i += of.step, ++from) MARS_SIDE_BY_SIDE
            for (int64_t k = 0; k < parts; ++k) {
                Part values;
                std::memcpy(&values, from + k * wide, sizeof(Part));
                sum[k] = sum[k] + values * of.weights[i];
            }
        }
        std::memcpy(of.out + g, sum, sizeof(sum));
    }
}

void MARS_JOIN(free_scores_, MARS_LEVEL)(const FreeScores& of) {
    constexpr int64_t together = kCorrelatedTogether;
    for (int64_t g = 0; g < of.points; g += together) {
        double known[together] = {};
        for (int a = 0; a < of.unknowns; ++a) {
            double left[together] = {};
            for (int b = 0; b < of.unknowns; ++b) {
                const double its = of.spread[a * of.unknowns + b], *along = of.along + b * of.length + g;
                for (int64_t k = 0; k < together; ++k) left[k] += its * along[k];
            }
            const double* along = of.along + a * of.length + g;
            for (int64_t k = 0; k < together; ++k) known[k] += left[k] * along[k];
            std::memcpy(of.left + a * of.length + g, left, sizeof left);
        }
        double variance[together], gain[together];
        for (int64_t k = 0; k < together; ++k) {
            const double whole = of.variance[g + k], rest = whole - known[k], score = of.score[g + k];
            variance[k] = rest > of.resolved * whole ? rest : 0.0;
            const double square = score > 0.0 ? score * score : 0.0;
            gain[k] = variance[k] > 0.0 ? square / variance[k] : 0.0;
        }
        std::memcpy(of.variance + g, variance, sizeof variance);
        std::memcpy(of.gain + g, gain, sizeof gain);
    }
    for (int64_t g = 0; g + 1 < of.points; g += together) {
        const int64_t size = std::min(together, of.points - 1 - g);
        double both[together], angle[together];
        for (int64_t k = 0; k < size; ++k) both[k] = of.beside[g + k];
        for (int a = 0; a < of.unknowns; ++a) {
            const double *along = of.along + a * of.length + g, *left = of.left + a * of.length + g + 1;
            for (int64_t k = 0; k < size; ++k) both[k] -= along[k] * left[k];
        }
        for (int64_t k = 0; k < size; ++k) {
            const double square = of.variance[g + k] * of.variance[g + k + 1];
            const double u = 1.0 - both[k] / std::sqrt(square > 0.0 ? square : 1.0);
            const double x = u > 0.0 ? u : 0.0, whole = std::sqrt(2.0 * x) * angle_series(x);
            angle[k] = square > 0.0 && u > 0.0 && u < kSmallAngle ? whole : -1.0;
        }
        std::copy_n(angle, size, of.angle + g);
    }
}

}  // namespace mars
