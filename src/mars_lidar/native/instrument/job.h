// What every engine is asked to do. Times are in laser periods, fluxes in photons per period.
#pragma once
#include "base/integers.h"

namespace mars {

// When a pixel registers an arrival (docs/detectors.md).
enum class DetectorMode : int32_t { kNonparalyzable, kParalyzable, kSynchronous, kGated };

// The open part of each period: arrivals outside of it do not exist. In period n it is [s, s + width) round the
// period, s = start + step * floor(n / cycles); start and step in [0, 1).
struct Gate {
    double start = 0.0, width = 1.0, step = 0.0;
    int32_t cycles = 1;
};

// Afterpulsing: every avalanche leaves Poisson(mean) carriers, released after delays of mean `mean_delay`: exponential,
// or sampled, `below` (samples + 1) is their distribution function at the edges of samples of `sample` periods.
struct Traps {
    double mean = 0.0, mean_delay = 0.0;
    const double* below = nullptr;
    int64_t samples = 0;
    double sample = 0.0;
    int32_t generations = INT32_MAX;  // avalanches of this generation leave none; photons trigger generation 0
};

// The probabilities that an avalanche triggers each of its neighbours, row by row, in an image of this size.
struct Crosstalk {
    double probability[9] = {};
    int64_t height = 0, width = 0;  // 0: none
};
struct Recording;

struct Job {
    int64_t pixels = 0;
    int64_t returns = 0;  // 0 with a waveform
    int64_t realizations = 1;
    uint32_t first_realization = 0;
    uint64_t seed = 0;
    int32_t cycles = 1;
    int32_t bins = 1;
    double dead_time = 0.0;
    bool stationary = false;  // warmed up at t = 0, else armed
    DetectorMode mode = DetectorMode::kNonparalyzable;
    Gate gate;  // of kGated
    Traps traps;
    double twilight = 0.0;  // arrivals this long before the end of a dead time fire at its end
    double recovery = 0.0;  // time constant with which the sensitivity returns after a dead time
    Crosstalk crosstalk;
    const Recording* recording = nullptr;  // of the registrations, or null: as they are
    const double* signal = nullptr;        // (returns, pixels)
    const double* delay = nullptr;         // (returns, pixels), finite, any number of periods
    const double* background = nullptr;    // (pixels)
    const double* waveform = nullptr;      // (pixels, samples): photons per sample, or null
    int64_t samples = 0;
    const uint32_t* pixel_index = nullptr;  // (pixels): names the random streams

    // Whether avalanches have consequences beyond the dead time.
    bool avalanches_matter() const {
        return traps.mean > 0.0 || twilight > 0.0 || recovery > 0.0 || crosstalk.width > 0;
    }
    // Of what avalanches leave behind: the longest mean duration.
    double aftermath() const { return traps.mean_delay > recovery ? traps.mean_delay : recovery; }
    int64_t items() const { return pixels * realizations; }  // item = realization * pixels + pixel
    uint32_t realization(int64_t item) const { return first_realization + static_cast<uint32_t>(item / pixels); }
    int64_t pixel(int64_t item) const { return item % pixels; }
};

// Time of a registration, in periods. A phase within 2^-25 of the end of its period is rounded to 1 in float32; it is
// below.
inline double registration_time(int32_t cycle, float phase) {
    const double exact = static_cast<double>(phase);
    return static_cast<double>(cycle) + (exact < 1.0 ? exact : 1.0 - 0x1p-25);
}

}  // namespace mars
