// The pulse on the cells of delay: image/engine.h.
#include <algorithm>
#include <cmath>

#include "image/engine.h"

namespace mars {
namespace {

constexpr double kLeastDensity = 1e-4;  // of the pulse, relative to its largest: beyond, its light counts as background
constexpr double kOutside =
    0.00621;  // of a Gaussian's energy beyond 2.5 sigma to either side, where signal is not counted
constexpr float kLeastExposure =
    0.05f;  // of a pulse behind the gate, relative to background: else its delay is excluded

}  // namespace

ImageSetting::ImageSetting(const HistogramRecord& record, int count, int64_t low, const std::vector<double>& density,
                           const std::vector<double>& asked, double deviation)
    : recording(&record), cells(count), sigma(deviation), least(kLeastExposure) {
    const int phases = kImagePhases;
    const int64_t samples = static_cast<int64_t>(density.size());
    double energy = 0.0, top = 0.0;
    for (const double x : density) {
        energy += x;
        top = std::max(top, x);
    }
    int64_t first = samples - 1, last = samples - 1;  // of the window in which signal is counted
    double below = 0.0, outside = 0.0;
    for (int64_t j = 0; j < last; ++j) {
        if (below + density[j] >= kOutside * energy && first > j) {
            first = j;
            outside = below;
        }
        below += density[j];
        if (below >= (1.0 - kOutside) * energy) last = j;
    }
    if (last == samples - 1) below = energy;
    inside = (below - outside) / energy;
    near = static_cast<double>(last + 1 - first) / phases;

    int64_t begin = 0, end = samples;
    while (density[begin] < kLeastDensity * top) ++begin;
    while (density[end - 1] < kLeastDensity * top) --end;
    curve_.resize(end - begin);
    score_.resize(end - begin);
    for (int64_t j = begin; j < end; ++j) {
        curve_[j - begin] = static_cast<float>(density[j]);
        score_[j - begin] = static_cast<float>(asked[j] * cells);
    }
    score = {phases,
             end - begin,
             static_cast<float>(low + begin) / static_cast<float>(phases),
             curve_.data(),
             score_.data(),
             static_cast<float>(static_cast<double>(low + first) / phases),
             static_cast<float>(static_cast<double>(low + last + 1) / phases)};

    // photon at (phase + 1/2) / phases of its cell, delay in the middle of the cell k further
    const int64_t from = low + begin, to = low + end;
    const int first_cell = static_cast<int>(std::ceil(-static_cast<double>(to) / phases - 0.5));
    const int last_cell =
        std::min(static_cast<int>(std::floor(-static_cast<double>(from) / phases + 0.5)), first_cell + cells - 1);
    const int span = last_cell + 1 - first_cell;
    table_.assign(static_cast<size_t>(phases) * span, 0.0f);
    float highest = 0.0f;
    for (int phase = 0; phase < phases; ++phase)
        for (int k = 0; k < span; ++k) {
            const int64_t j = phase - phases / 2 - static_cast<int64_t>(first_cell + k) * phases - from;
            if (j < 0 || j >= end - begin) continue;
            table_[static_cast<size_t>(phase) * span + k] = curve_[j];
            highest = std::max(highest, curve_[j]);
        }
    pulse = {phases, first_cell, span, highest, table_.data()};
}

}  // namespace mars
