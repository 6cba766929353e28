// The likelihood of histograms in coarse bins at one vector level: its entry points. Lanes are pixels.
#include "reconstruct/coarse_kernel.h"

#include "reconstruct/coarse_likelihood.h"

namespace mars {
namespace {

inline void write(const Real& value, int k, double*& to) { *to++ = lane(value, k); }
template <class T>
void write(const Jet<T>& value, int k, double*& to) {
    write(value.value, k, to);
    for (const T& slope : value.slope) write(slope, k, to);
}

template <class T>
void evaluate(const CoarseBlock& block) {
    CoarseLikelihood<T> likelihood(block.plan);
    const int64_t bins = block.plan.record.bins;
    for (int64_t first = 0; first < block.pixels; first += kReals) {
        const double* counts[kReals];
        Real light[3];
        for (int k = 0; k < kReals; ++k) {  // the last pixel again where there are no more
            const int64_t p = first + k < block.pixels ? first + k : block.pixels - 1;
            counts[k] = block.counts + p * bins;
            for (int i = 0; i < 3; ++i) set_lane(light[i], k, block.light[3 * p + i]);
        }
        const T value = likelihood(counts, light);
        double* to = block.out + first * static_cast<int64_t>(sizeof(T) / sizeof(Real));
        for (int k = 0; k < kReals && first + k < block.pixels; ++k) write(value, k, to);
    }
}

}  // namespace

void MARS_JOIN(coarse_gradient_, MARS_LEVEL)(const CoarseBlock& block) { evaluate<Jet<Real>>(block); }

#if defined(MARS_LEVEL_vector128) || defined(MARS_LEVEL_scalar)
void MARS_JOIN(coarse_curvature_, MARS_LEVEL)(const CoarseBlock& block) { evaluate<Jet<Jet<Real>>>(block); }
#endif

}  // namespace mars
