// Jitter and the codes of a converter for the lanes of the exact engine: instrument/recording.h holds what is asked
// for, these functions move and code the phases of registrations (docs/detectors.md, "Effects").
#pragma once
#include <algorithm>

#include "exact/registration.h"
#include "instrument/pulse_table.h"
#include "instrument/recording.h"
#include "numbers/lane_math.h"

namespace mars {
inline namespace MARS_LEVEL {

struct JitterView {
    bool on = false, gaussian = false;
    float sigma = 0.0f;
    const float* bound = nullptr;  // of a JitterTable; likewise below
    const float* line = nullptr;
    uint32_t samples = 0;
    float tail = 0.0f;
    uint32_t tail_below = 0;  // of a 32-bit word; the tail takes no record where 0
    float tail_scale = 0.0f;  // spreads the words below that over 31 bits
};

inline JitterView jitter_view(const Recording& recording) {
    JitterView view{};
    if (!recording.jitter) return view;
    view.on = true;
    view.gaussian = recording.jitter->shape.gaussian();
    view.sigma = static_cast<float>(recording.jitter->shape.sigma);
    view.bound = recording.jitter_table.bound.data();
    view.line = recording.jitter_table.line.data();
    view.samples = static_cast<uint32_t>(recording.jitter_table.bound.size());
    view.tail = static_cast<float>(recording.tail);
    view.tail_below = static_cast<uint32_t>(std::min(recording.tail_fraction * 0x1p32, 0x1p32 - 1.0));
    view.tail_scale = view.tail_below ? static_cast<float>(1.0 / recording.tail_fraction) : 0.0f;
    return view;
}

// The jitter of a record from a word, for sampled densities.
MARS_INLINE Float sampled_jitter(const JitterView& jitter, UInt word) {
    UInt column, place;
    multiply(word, jitter.samples, column, place);
    const Float v = to_float(as_int(place >> 1)) * 0x1p-31f;
    const Int other = one_if(v >= gather(jitter.bound, as_int(column)));
    Float first, slope;
    gather_pair(jitter.line, as_int(column << 1) + other, first, slope);
    return first + slope * v;
}

// The jitter of two records from two words.
template <bool gaussian>
MARS_INLINE Pair<Float> jitter_of(const JitterView& jitter, Pair<UInt> words) {
    if constexpr (!gaussian) return {sampled_jitter(jitter, words.first), sampled_jitter(jitter, words.second)};
    const Pair<Float> normal = normal_pair(words);
    return {normal.first * jitter.sigma, normal.second * jitter.sigma};
}

// The exponential tail of some records: given that it is below the bound the word is uniform again.
MARS_INLINE Float tail_of(const JitterView& jitter, UInt word) {
    const Float stretched = minimum(to_float(as_int(word >> 1)) * jitter.tail_scale, splat(kIntegerMost));
    const Float delay = exponential(as_uint(truncate(stretched)) << 1) * jitter.tail;
    return select(word < splat(jitter.tail_below), delay, splat(0.0f));
}

// Whole periods of a time, which becomes its phase in [0, 1).
MARS_INLINE Int split_off_periods(Float& phase) {
    Int whole = truncate(phase);
    whole = minus_if(whole, phase < to_float(whole));
    phase = minimum(phase - to_float(whole), splat(0x1.fffffep-1f));
    return whole;
}

// The bin of a phase, which becomes, if `timed`, the phase that the converter tells: as far into its code, one bin
// wide, as the time is into the code's width.
MARS_INLINE Int convert(const CodeTable& codes, int32_t bins, Float& phase, bool timed) {
    const int32_t n = static_cast<int32_t>(codes.upper.size());
    const Float x = phase * static_cast<float>(bins);
    Int pattern = minimum(truncate(x * codes.patterns_per_bin), splat(bins / n - 1));
    pattern = minus_if(pattern, x < to_float(pattern) * static_cast<float>(n));  // rounding; likewise below
    const Float first = to_float(pattern) * static_cast<float>(n);
    const Float inside = minimum(x - first, splat(static_cast<float>(n) * 0x1.fffffep-1f));
    Int code = gather(codes.guide.data(), truncate(inside * codes.cells_per_bin));
    Float upper = gather(codes.upper.data(), code);
    Mask beyond = inside >= upper;
    while (any(beyond)) {
        code = plus_if(code, beyond);
        upper = gather(codes.upper.data(), code);
        beyond = inside >= upper;
    }
    if (timed) {
        const Float left = minimum((upper - inside) * gather(codes.codes_per_bin.data(), code), splat(1.0f));
        const Float told = (first + to_float(code)) + (1.0f - maximum(left, splat(0x1p-24f)));
        phase = minimum(told * (1.0f / static_cast<float>(bins)), splat(0x1.fffffep-1f));
    }
    return minimum(truncate(first) + code, splat(bins - 1));
}

}  // namespace MARS_LEVEL
}  // namespace mars
