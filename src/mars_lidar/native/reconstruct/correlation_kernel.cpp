// Correlation of a histogram with a short template, points side by side in the lanes.
#include "reconstruct/correlation_kernel.h"

#include <cstring>

#include "lanes/doubles.h"

namespace mars {

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
            for (int64_t i = q; i < of.taps; i += of.step, ++from)
                for (int64_t k = 0; k < parts; ++k) {
                    Part values;
                    std::memcpy(&values, from + k * wide, sizeof(Part));
                    sum[k] = sum[k] + values * of.weights[i];
                }
        }
        std::memcpy(of.out + g, sum, sizeof(sum));
    }
}

}  // namespace mars
