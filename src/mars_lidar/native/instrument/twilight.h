// How long twilight pulses, which trigger each other, keep a pixel from forgetting its start.
#pragma once
#include <cmath>

#include "instrument/job.h"

namespace mars {

// Dead times for which a pixel remembers its phase because twilight pulses trigger each other. A dead time ends with one
// with the probability 1 - e^-photons at most: background, and the signal where a dead time is whole periods but for less
// than the twilight. After 10 e^photons dead times such a sequence lasts with probability e^-10.
inline double twilight_memory(const Job& job, int64_t pixel) {
    if (job.twilight == 0.0) return 0.0;
    double photons = job.background[pixel] * job.twilight;
    if (std::abs(job.dead_time - std::nearbyint(job.dead_time)) < job.twilight) {
        const double pulses = std::ceil(job.twilight);
        for (int64_t k = 0; k < job.returns; ++k)
            if (job.signal[k * job.pixels + pixel] > 0.0) photons += pulses * job.signal[k * job.pixels + pixel];
        for (int64_t k = 0; job.waveform && k < job.samples; ++k)
            photons += pulses * job.waveform[pixel * job.samples + k];
    }
    return 10.0 * std::exp(photons);
}

}  // namespace mars
