// One registration of the exact engine and how an item begins: what its loop on the processor (exact/runner.h) and
// its kernel on a GPU (cuda/exact.h) share.
#pragma once
#include "exact/detector_modes.h"
#include "exact/registration.h"

namespace mars {
inline namespace MARS_LEVEL {

// One registration of each lane.
struct Registration {
    Time hit;   // in frames
    Int cycle;  // the same in laser periods
    Float phase;
    Mask lost;
};

// What becomes of an arrival at pixels that were armed; `armed` moves on. `delay` is that of the first return, `unseen`
// tells the arrivals that the detector's mode does not register.
template <DetectorMode mode>
MARS_INLINE Registration register_arrival(const SystemView& system, const Time& hit, Float delay, UInt event,
                                          Time& armed, Memory& memory, Mask& unseen) {
    if constexpr (mode == DetectorMode::kNonparalyzable) armed = rearm(system, hit);
    const Time seen = in_period(hit, delay);
    const Int cycle = seen.frame;
    const Float phase = seen.phase;
    // inside the exposure: 0 <= cycle < cycles, one unsigned comparison
    Mask outside = as_uint(cycle) >= static_cast<uint32_t>(system.cycles);
    if constexpr (mode != DetectorMode::kNonparalyzable) {
        unseen = advance<mode>(system, hit, cycle, phase, delay, event, armed, memory);
        outside = outside | unseen;
    }
    return {hit, cycle, phase, outside};
}

// The next registration of pixels that re-armed at `armed`.
template <DetectorMode mode, PulseKind kind, bool whole>
MARS_INLINE Registration register_next(const SystemView& system, const Return* returns, Float delay, const Draw& drawn,
                                       UInt key0, UInt key1, UInt event, Time& armed, Memory& memory) {
    const Time hit = next_registration<kind, whole>(system, returns, armed, drawn, key0, key1, event, memory);
    Mask unseen = splat(0) > 0;
    return register_arrival<mode>(system, hit, delay, event, armed, memory, unseen);
}

MARS_INLINE Int bin_of(Float phase, int32_t bins) {
    return minimum(truncate(phase * static_cast<float>(bins)), splat(bins - 1));
}

// `periods` in [0, 1).
MARS_INLINE float wrapped(double periods) {
    const double whole_periods = static_cast<double>(static_cast<int64_t>(periods));
    const float rest = static_cast<float>(periods - whole_periods + (periods < whole_periods ? 1.0 : 0.0));
    return rest < 1.0f ? rest : 0.0f;
}

// Distance of two returns, in [-1/2, 1/2) periods.
MARS_INLINE float offset_of(double delay, double first_delay) {
    const float apart = wrapped(delay - first_delay);
    return apart < 0.5f ? apart : apart - 1.0f;
}

MARS_INLINE void plain_rate(double photons, float& rate, float& inverse) {
    const float r = static_cast<float>(photons);
    const bool dark = !(r >= 1.0f / kDarkInverse);
    rate = dark ? 0.0f : r;
    inverse = dark ? kDarkInverse : 1.0f / r;
}

// A phase of period `cycle` in the frames of the first return.
MARS_INLINE void start_in_frames(int32_t cycle, float phase, float delay, int32_t& frame, float& frame_phase) {
    const float start = phase - delay;
    const int32_t wrap = (start >= 0.5f ? 1 : 0) - (start < -0.5f ? 1 : 0);
    frame_phase = start - static_cast<float>(wrap);
    frame = cycle + wrap;
}

}  // namespace MARS_LEVEL
}  // namespace mars
