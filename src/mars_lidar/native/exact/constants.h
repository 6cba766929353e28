// The constants of the exact engine, which waveforms and the CUDA kernel share. Random numbers and grids of the start
// change the bits of a result, speed does not. Times are in laser periods where nothing else is said.
#pragma once
#include "base/integers.h"

namespace mars {

// Random numbers. Arrivals of the background and the first return are drawn from the item's stream of words
// (numbers/word_stream.h); every other draw is a function of the item's key and two counter words (numbers/random.h):
// the number of the registration, and one of these, which differ so that no two draws share a word.
constexpr uint32_t kStageArrivalFine = 1;  // fresh fractions for long waits of the background and the first return
constexpr uint32_t kStageStart = 2;        // arrivals before a stationary exposure: waits and components; + 1: phases
constexpr uint32_t kStageJitter = 4;       // first word of the counter: half the number; + 1: tails
constexpr uint32_t kStageRecovery = 6;     // what of its sensitivity an arrival asks of the pixel; + 1: fine fractions
constexpr uint32_t kStageReturns = 16;     // + 2 k: returns 2 k + 1 and 2 k + 2; + 2 k + 1: their fractions
constexpr uint32_t kStageTails = 64;       // + k: place of an arrival in the tails of return k
constexpr uint32_t kStageTraps = 0x40000000;  // afterpulses, by the number of the avalanche that leaves carriers (+ k)

// Lattice of the random numbers (docs/theory_exact.md, section 2).
constexpr float kLongWait = 256.0f;  // `split_wait` resolves 2^-24 up to here; beyond, fractions are drawn afresh
constexpr float kTail = 0x1p-14f - 0x1p-25f;   // energies nearer to 0 are drawn afresh; of the lattice of 2^-24 near 1
constexpr int kEnergyShift = 16;               // the leading bits of an energy are its cell in the tables of pulses
constexpr float kIntegerMost = 2147483520.0f;  // 2^31 - 2^7: the largest float32 that is an int32

// Ranges: what is beyond them does not occur.
constexpr int kMaxReturns = 16;            // echoes of one pixel, as `returns` of light/tolerances.py
constexpr float kForever = 134217728.0f;   // 2^27: beyond every exposure
constexpr float kDarkInverse = 1e30f;      // 1 / rate of a component without photons: every wait is kForever
constexpr double kDarkest = 1e-30;         // photons per period: darker pixels are armed at the start of the exposure
constexpr int32_t kIdleFrame = 100000001;  // every exposure has ended; + kAhead (kForever + t_d) fits 32 bits
constexpr int32_t kNever = INT32_MAX;      // period of the next release at pixels without carriers
constexpr int32_t kRested = 1 << 26;       // since the last avalanche before an item: 67 of the longest time constant
constexpr int kMostCarriers = 64;          // of one avalanche: more come with probability < 1e-89

// The start of a stationary exposure: the state of a pixel is solved on a grid of one period, or drawn from the
// arrivals before. A locked pixel registers within a fraction of the pulse, to which it returns: on a grid for the
// pulse alone (S = 612, 2 parts a standard deviation) 4 % of its registrations moved to the next bin; it has the
// finest.
constexpr int64_t kStartParts = 1024;        // of a grid, where pulse and gate are wide
constexpr int64_t kStartPartsMost = 16384;   // of a grid, where they are narrow or the pixel is locked
constexpr double kPulseParts = 7.0;          // of a grid, in the equivalent width of a pulse
constexpr double kGatedPulseParts = 28.0;    // the same behind a gate, whose edges cut the pulse
constexpr double kGateParts = 64.0;          // of a grid, in the width of a gate
constexpr double kLockedSignal = 4.0;        // photons per period of a locked pixel, at least
constexpr double kLockedDrift = 0.25;        // of its registrations in a dead time, widths of the pulse at most
constexpr double kLockedTolerance = 1e-7;    // of the state of a locked pixel, as ExposureGrid::tolerance
constexpr double kWarmUpPhotons = 40.0;      // before the exposure: e^-40 is below the resolution of the draws
constexpr double kGapPhotonsMost = 8.0;      // in a dead time, of pixels whose last gap before the exposure is searched
constexpr double kGapArrivalsMost = 1500.0;  // that such a search is expected to draw: some 40 us

// Speed: the results are the same for every value.
constexpr int kAhead = 8;               // registrations of a round, whose waits are drawn ahead
constexpr int kLead = 2;                // draws before the step that takes them: they fill gaps in the chain of steps
constexpr int64_t kMaxItems = 4096;     // of a block, the share of a thread
constexpr int kPollEvery = 512;         // rounds between looks at `stop`
constexpr int kLog = 128;               // rows of the log; a multiple of kAhead
constexpr uint32_t kMostOwn = 2048;     // bins of histograms in the lanes' own rows: 64 or 128 KB for all lanes
constexpr uint32_t kCacheLine = 64;     // bytes
constexpr uint32_t kPrefetched = 4096;  // bytes of the next row, at most

}  // namespace mars
