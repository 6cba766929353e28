// Sums over the parts of a waveform: their total, and C at their edges. All vector levels give the same bits: the total
// is added up in one order, and the energies as integers, for which no order matters.
#pragma once
#include <cstring>

#include "lanes/doubles.h"

namespace mars {
inline namespace MARS_LEVEL {

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

// The energy of a part as an integer is the mantissa of photons * unit + dark with dark >= 2^52; the bits above cancel
// in what is kept of the sums, bits kDropped to 51.
constexpr int kDropped = 20;
constexpr double kNoEnergy = 0x1p52, kWholeEnergy = 0x1p51;

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
        store_energies<kDropped>(end + j, less(both, second), both);
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
