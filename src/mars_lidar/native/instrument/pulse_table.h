// The sampler's tables of one pulse.
//
// The period is cut into a frame [-1/2, 1/2) around `centre`. The energy F(v) below v is kept *signed*: F in
// the early half, F - 1 in the late half, so that both tails are relatively accurate in float32 (at S = 10 it
// is the early tail that registers, at -5 sigma, where F = 3e-7). Quantiles are tabulated on cells of equal
// *relative* width of |p|, 128 an octave, for the same reason.
#pragma once
#include <cstdint>
#include <vector>

#include "instrument/pulse.h"

namespace mars {

constexpr int kOctaveShift = 16;  // 2^7 cells an octave
constexpr int kOctaves = 56;      // below 2^-56, 8.5 sigma of a Gaussian, there is no energy

struct PulseTable {
    PulseShape shape;
    double centre = 0.0;          // of the frame, relative to the delay
    float cell_of_centre = 0.0f;  // number of cells, with the guard, before the centre; a fraction for an odd number
    float cells_per_period = 0.0f;
    int32_t cells = 0;
    int32_t late_cell = 0;       // of `forward`: the late half begins with it ...
    float split = 0.5f;          // ... where the energy F has this value
    std::vector<float> forward;  // (cells + 2, 2): signed energy at the cell's start, and its increase

    std::vector<float> inverse;  // Gaussian: (octave cells, 2): intercept and slope of the early quantile

    std::vector<int32_t> guide;                         // sampled: (2, guides): first sample to look at, early and late
    std::vector<float> upper, end, periods_per_energy;  // sampled: per sample that carries energy
    int32_t guides = 0, last_early = 0, last_late = 0;

    static PulseTable gaussian(double sigma);
    static PulseTable sampled(std::vector<double> knots, double width, double start);
};

}  // namespace mars
