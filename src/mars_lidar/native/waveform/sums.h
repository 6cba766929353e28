// Sums over the parts of a waveform: their total, and C at their edges. All vector levels give the same bits: the total is
// added up in one order, and the energies as integers, for which no order matters.
#pragma once
#include <cstring>

#include "lanes/lanes.h"

namespace mars {
inline namespace MARS_LEVEL {

// Numbers of 64 bits, half as many as of 32.
#if defined(MARS_LEVEL_avx512)
#define MARS_WIDE 8
using Doubles = __m512d;
using Longs = __m512i;
#elif defined(MARS_LEVEL_avx2)
#define MARS_WIDE 4
using Doubles = __m256d;
using Longs = __m256i;
#elif MARS_LANES > 1 && defined(MARS_X86)
#define MARS_WIDE 2
using Doubles = __m128d;
using Longs = __m128i;
#else
#define MARS_WIDE 1
#endif

// Photons of all parts, without the background: in kTotals sums side by side, because each addition waits for the one
// before it.
MARS_NOINLINE inline double total_of(const double* photons, int64_t parts) {
    constexpr int64_t kTotals = 32;
    alignas(64) double sum[kTotals] = {};
    int64_t j = 0;
#if MARS_WIDE > 1
    Doubles sums[kTotals / MARS_WIDE] = {};
    for (; j + kTotals <= parts; j += kTotals)
        for (int k = 0; k < kTotals / MARS_WIDE; ++k) {
            Doubles next;
            memcpy(&next, photons + j + k * MARS_WIDE, sizeof next);
            sums[k] += next;
        }
    memcpy(sum, sums, sizeof sum);
#else
    for (; j + kTotals <= parts; j += kTotals)
        for (int k = 0; k < kTotals; ++k) sum[k] += photons[j + k];
#endif
    for (int k = 0; j < parts; ++j, ++k) sum[k] += photons[j];
    for (int width = kTotals / 2; width > 0; width /= 2)
        for (int k = 0; k < width; ++k) sum[k] += sum[k + width];
    return sum[0];
}

// The energy of a part as an integer is the mantissa of photons * unit + dark with dark >= 2^52; the bits above cancel in
// what is kept of the sums, bits kDropped to 51.
constexpr int kDropped = 20;
constexpr double kNoEnergy = 0x1p52, kWholeEnergy = 0x1p51;

#if MARS_WIDE > 1
// The parts with even numbers, those with odd ones, and the sums of the longs up to each of them.
#if defined(MARS_LEVEL_avx512)
MARS_INLINE void load_parts(const double* from, Doubles& even, Doubles& odd) {
    const Doubles low = _mm512_loadu_pd(from), high = _mm512_loadu_pd(from + 8);
    even = _mm512_permutex2var_pd(low, _mm512_setr_epi64(0, 2, 4, 6, 8, 10, 12, 14), high);
    odd = _mm512_permutex2var_pd(low, _mm512_setr_epi64(1, 3, 5, 7, 9, 11, 13, 15), high);
}
MARS_INLINE Longs add(Longs a, Longs b) { return _mm512_add_epi64(a, b); }
MARS_INLINE Longs running(Longs x) {
    const Longs none = _mm512_setzero_si512();
    x = add(x, _mm512_alignr_epi64(x, none, 7));
    x = add(x, _mm512_alignr_epi64(x, none, 6));
    return add(x, _mm512_alignr_epi64(x, none, 4));
}
MARS_INLINE Longs last_of(Longs x) { return _mm512_permutexvar_epi64(_mm512_set1_epi64(7), x); }
MARS_INLINE void store_energies(int32_t* to, Longs even, Longs odd) {
    const Longs low = _mm512_srli_epi64(even, kDropped), high = _mm512_slli_epi64(odd, 32 - kDropped);
    _mm512_storeu_si512(to, _mm512_mask_blend_epi32(0xaaaa, low, high));
}
MARS_INLINE Longs less(Longs a, Longs b) { return _mm512_sub_epi64(a, b); }
MARS_INLINE Longs nothing() { return _mm512_setzero_si512(); }
MARS_INLINE Doubles all(double x) { return _mm512_set1_pd(x); }
#elif defined(MARS_LEVEL_avx2)
MARS_INLINE void load_parts(const double* from, Doubles& even, Doubles& odd) {
    const auto two = [](const double* a, const double* b) {
        return _mm256_insertf128_pd(_mm256_castpd128_pd256(_mm_loadu_pd(a)), _mm_loadu_pd(b), 1);
    };
    const Doubles low = two(from, from + 4), high = two(from + 2, from + 6);
    even = _mm256_unpacklo_pd(low, high);
    odd = _mm256_unpackhi_pd(low, high);
}
MARS_INLINE Longs add(Longs a, Longs b) { return _mm256_add_epi64(a, b); }
MARS_INLINE Longs running(Longs x) {
    x = add(x, _mm256_slli_si256(x, 8));
    const Longs lower = _mm256_permute2x128_si256(x, x, 0x08);  // its low half, above nothing
    return add(x, _mm256_unpackhi_epi64(lower, lower));
}
MARS_INLINE Longs last_of(Longs x) { return _mm256_permute4x64_epi64(x, 0xff); }
MARS_INLINE void store_energies(int32_t* to, Longs even, Longs odd) {
    const Longs low = _mm256_srli_epi64(even, kDropped), high = _mm256_slli_epi64(odd, 32 - kDropped);
    _mm256_storeu_si256((__m256i*)to, _mm256_blend_epi32(low, high, 0xaa));
}
MARS_INLINE Longs less(Longs a, Longs b) { return _mm256_sub_epi64(a, b); }
MARS_INLINE Longs nothing() { return _mm256_setzero_si256(); }
MARS_INLINE Doubles all(double x) { return _mm256_set1_pd(x); }
#else
MARS_INLINE void load_parts(const double* from, Doubles& even, Doubles& odd) {
    const Doubles low = _mm_loadu_pd(from), high = _mm_loadu_pd(from + 2);
    even = _mm_unpacklo_pd(low, high);
    odd = _mm_unpackhi_pd(low, high);
}
MARS_INLINE Longs add(Longs a, Longs b) { return _mm_add_epi64(a, b); }
MARS_INLINE Longs running(Longs x) { return add(x, _mm_slli_si128(x, 8)); }
MARS_INLINE Longs last_of(Longs x) { return _mm_unpackhi_epi64(x, x); }
MARS_INLINE void store_energies(int32_t* to, Longs even, Longs odd) {
    const Longs low = _mm_srli_epi64(even, kDropped), high = _mm_slli_epi64(odd, 32 - kDropped);
    const Longs upper = _mm_set_epi32(-1, 0, -1, 0);
    _mm_storeu_si128((__m128i*)to, _mm_or_si128(_mm_andnot_si128(upper, low), _mm_and_si128(upper, high)));
}
MARS_INLINE Longs less(Longs a, Longs b) { return _mm_sub_epi64(a, b); }
MARS_INLINE Longs nothing() { return _mm_setzero_si128(); }
MARS_INLINE Doubles all(double x) { return _mm_set1_pd(x); }
#endif
#endif

// The ends of the parts in energy: `unit` is what a photon has, kWholeEnergy a whole period or a little less, and
// `dark` kNoEnergy and the energy of the background in a part.
MARS_NOINLINE inline void add_up(const double* photons, int64_t parts, double unit, double dark, int32_t* end) {
    uint64_t before = 0;
    int64_t j = 0;
#if MARS_WIDE > 1
    const Doubles units = all(unit), darks = all(dark);
    Longs sum = nothing();
    for (; j + 2 * MARS_WIDE <= parts; j += 2 * MARS_WIDE) {
        Doubles even, odd;
        load_parts(photons + j, even, odd);
        const Longs first = (Longs)(even * units + darks), second = (Longs)(odd * units + darks);
        const Longs inside = running(add(first, second)), both = add(sum, inside);
        sum = add(sum, last_of(inside));
        store_energies(end + j, less(both, second), both);
    }
    memcpy(&before, &sum, sizeof before);
#endif
    for (; j < parts; ++j) {
        const double energy = photons[j] * unit + dark;
        uint64_t bits;
        memcpy(&bits, &energy, sizeof bits);
        before += bits;
        end[j] = static_cast<int32_t>(static_cast<uint32_t>(before >> kDropped));
    }
}

}  // namespace MARS_LEVEL
}  // namespace mars
