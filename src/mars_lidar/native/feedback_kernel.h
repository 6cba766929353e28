// The feedback engine's inner loops, one function per vector level (feedback_kernel.cpp is compiled once for each).
// Symbols and steps are those of docs/feedback.md.
#pragma once
#include <atomic>
#include <cstdint>
#include <vector>

namespace mars {

constexpr int kTeam = 32;  // lanes of a batch at every level: two vectors of AVX-512

// One laser period on n internal bins of width 1/n; dead time K + (d + f)/n periods.
struct FeedbackGrid {
    int32_t bins = 1;        // n
    int32_t merge = 1;       // internal bins in a bin of the histogram
    int32_t whole = 0;       // K
    int32_t shift = 1;       // d, 1 <= d <= n
    double fraction = 0.0;   // f, 0 <= f < 1
    double dead_time = 0.0;  // in periods
    int32_t cycles = 1;
    bool stationary = false;
};

enum class FeedbackStatus : uint8_t {
    kDrawn = 0,
    kSlow = 1,    // the sweeps contract too slowly
    kLocked = 2,  // a count law narrower than whole blind periods resolve
};

// One batch: kTeam exposures at a time, each lane its own pixel. A lane counts internal bins from a first bin of its
// own, so that the pulses of different pixels lie in the same bins.
struct FeedbackBatch {
    const FeedbackGrid* grid;
    const int32_t* first_bin;     // (kTeam): place in the period of the lane's bin 0, a multiple of `merge`
    const double* dark_photons;   // (kTeam): per period in a bin without signal
    int32_t lit_begin, lit_end;   // bins that may have signal ...
    const double* lit_photons;    // ... (lit_end - lit_begin, kTeam): theirs, background included
    const uint32_t* pixel_index;  // (kTeam)
    const uint32_t* realization;  // (kTeam): of the first draw
    uint32_t realization_step;    // from draw to draw
    const int32_t* draws;         // (kTeam): of each lane; 0 is an idle lane
    uint64_t seed;
    void* const* rows;            // (kTeam): histogram of the first draw
    int64_t row_step;             // counts from draw to draw
    bool wide;                    // uint32 counts, else uint16
    FeedbackStatus* status;       // (kTeam)
    std::vector<unsigned char>* memory;  // scratch, kept between batches
    const std::atomic<bool>* stop;
};

// Returns false where a count does not fit into its histogram bin.
#define MARS_DECLARE_FEEDBACK(level) bool feedback_kernel_##level(const FeedbackBatch& batch);
MARS_DECLARE_FEEDBACK(scalar)
MARS_DECLARE_FEEDBACK(vector128)
MARS_DECLARE_FEEDBACK(avx2)
MARS_DECLARE_FEEDBACK(avx512)

}  // namespace mars
