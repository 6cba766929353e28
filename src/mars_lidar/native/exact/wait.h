// The waits of a pixel's components for their next photon: exponential, and finer than the lattice of float32.
//
// Whole periods and the fraction of an exponential wait are independent of each other. Both come from one word; what of
// the fraction that word cannot resolve is drawn afresh (docs/theory_exact.md, section 2).
#pragma once
#include "exact/constants.h"
#include "numbers/word_stream.h"

namespace mars {
inline namespace MARS_LEVEL {

// Flux of one component at the lane's pixel. A component without photons has rate = 0 and inverse = kDarkInverse.
struct Rate {
    Float rate, inverse;
};

struct Wait {
    Int whole;
    Float fraction;  // in [0, 1)
};

// Whole periods and rest of a wait. A float32 knows waits of 64 periods to 2^-17 of one, and the random numbers that it
// is made of have a lattice of their own. So only the 16 leading bits are kept. They name a cell of 2^-15 times the
// power of two below the wait, in which its law is uniform but for a slope of 2^-15 times the exponential number;
// `place`, uniform in (0, 2^-15) and independent of the wait, draws afresh where in the cell it ends.
MARS_INLINE Wait split_wait(Float wait, Float place) {
    const Float cell = from_bits(bits(wait) & 0xffffff00u), power = from_bits(bits(wait) & 0x7f800000u);
    const Int whole = truncate(cell);
    return {whole, (cell - to_float(whole)) + power * place};
}

// The fraction of a long wait afresh. Exact, since whole periods and fraction of an exponential wait are independent;
// the fraction has the density ~ e^(-rate r) on [0, 1).
MARS_INLINE void refresh(Wait& wait, Mask lanes, UInt word, Float rate) {
    const Float v = uniform(word);
    const Float bend = 0.5f * rate * v * (1.0f - v) * (1.0f - rate * (1.0f - 2.0f * v) * 0.33333334f);
    wait.fraction = select(lanes, v - bend, wait.fraction);
}

// Of waits beyond kLongWait, where cells grow longer than a period: whole periods of float32, fractions of their own.
MARS_INLINE void refresh_long(Float wait_a, Float wait_b, const Rate& a, const Rate& b, UInt key0, UInt key1,
                              UInt event, uint32_t fine_stage, Wait& split_a, Wait& split_b) {
    const Mask long_a = wait_a >= kLongWait, long_b = wait_b >= kLongWait;
    split_a = {select(long_a, truncate(wait_a), split_a.whole), select(long_a, splat(0.5f), split_a.fraction)};
    split_b = {select(long_b, truncate(wait_b), split_b.whole), select(long_b, splat(0.5f), split_b.fraction)};
    const Mask fresh_a = long_a & (wait_a < kForever), fresh_b = long_b & (wait_b < kForever);
    if (!any(fresh_a | fresh_b)) return;
    const Pair<UInt> fine = threefry<13>(event, splat(fine_stage), key0, key1);
    refresh(split_a, fresh_a, fine.first, a.rate);
    refresh(split_b, fresh_b, fine.second, b.rate);
}

MARS_INLINE void split_waits(Float wa, Float wb, Float place, const Rate& a, const Rate& b, UInt key0, UInt key1,
                             UInt event, uint32_t fine_stage, Wait& wait_a, Wait& wait_b) {
    const bool far = any_reaches(wa, wb, kLongWait);
    if (far) {
        wa = minimum(wa, splat(kForever));
        wb = minimum(wb, splat(kForever));
    }
    wait_a = split_wait(wa, place);
    wait_b = split_wait(wb, place);
    if (far) refresh_long(wa, wb, a, b, key0, key1, event, fine_stage, wait_a, wait_b);
}

// Waits of two components, in periods (background) or pulse energies (returns). The place in their cells comes from the
// low bits of the sum of their words: given either word it is uniform by the other.
MARS_INLINE void draw_waits(UInt key0, UInt key1, UInt event, uint32_t stage, const Rate& a, const Rate& b,
                            Wait& wait_a, Wait& wait_b) {
    const Pair<UInt> words = threefry<13>(event, splat(stage), key0, key1);
    const Float place = dither(words.first + words.second), rest = place * 0x1p15f;
    split_waits(exponential(words.first, rest) * a.inverse, exponential(words.second, rest) * b.inverse, place, a, b,
                key0, key1, event, stage + 1, wait_a, wait_b);
}

// -log of the product of two uniform numbers: a Gamma(2) number, relatively fine up to 43.
MARS_INLINE Float two_exponentials(UInt x, UInt y) {
    const Float product = to_float(as_int(x | 1u)) * to_float(as_int(y | 1u));  // odd integers of either sign
    // the magnitude is m 2^e with m in [sqrt(1/2), sqrt(2))
    const UInt shifted = (bits(product) & 0x7fffffffu) - kRootHalfBits;
    const Int e = as_int(shifted) >> 23;
    const Float t = from_bits((shifted & kMantissaBits) + kRootHalfBits) - 1.0f;
    const Float p = log_polynomial(t) * t - 0.5f;
    const Float log1p = t + (t * t) * p;
    return maximum(to_float(62 - e) * kLogTwo - log1p, splat(0x1p-25f));  // two factors rounded up to 1: not below 0
}

// The same as `draw_waits` from three words of a stream, by one logarithm: of a Gamma(2) number G and an independent
// uniform one U, U G and (1 - U) G are independent exponential numbers. `key`, `event` and `fine_stage` are for long waits.
MARS_INLINE void draw_two_waits(WordStream<UInt>& stream, UInt key0, UInt key1, UInt event, uint32_t fine_stage,
                                const Rate& a, const Rate& b, Wait& wait_a, Wait& wait_b) {
    const UInt x = stream.next(), y = stream.next(), z = stream.next();
    const Float place = dither(x + y), rest = place * 0x1p15f;
    const Float sum = two_exponentials(x, y) * 0x1p-31f;
    const Int part = as_int(z >> 1);
    const Float wa = (to_float(part) + rest) * (sum * a.inverse),
                wb = (to_float(0x7fffffff - part) + rest) * (sum * b.inverse);
    split_waits(wa, wb, place, a, b, key0, key1, event, fine_stage, wait_a, wait_b);
}

}  // namespace MARS_LEVEL
}  // namespace mars
