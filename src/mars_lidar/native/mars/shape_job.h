// What histograms from a count and a shape are drawn from: rows of a table, how pixels mix and move them, and what
// is known of the pulse that they hold. Plain numbers and pointers, which a GPU takes as they are.
#pragma once
#include "base/integers.h"

namespace mars {

// Flux of the pulse at the table's own delay, in the bins that it reaches: the frame.
struct PulseFrame {
    int32_t first = 0;              // bin, of the period
    int32_t size = 0;               // bins; at most all of them
    int32_t parts = 1;              // of a bin
    int32_t cells = 1;              // of a bin, a divisor of `parts`: where registrations re-arm in the pulse
    const float* energy = nullptr;  // (parts + 1, size): of the pulse, from a bin's start to part p of it
};

// What the photons drawn one by one need of a row: its bins outside of the frame, in cyclic order from the frame's end,
// are cut into `kParts` parts of a power of two of bins.
constexpr int kParts = 31;
struct RowGuide {
    float low[kParts + 1];   // least value within a part; at last the sum over the dead time before the frame
    float high[kParts + 1];  // largest value; at last 1 where the row has been looked at
};

struct ShapeJob {
    int64_t pixels = 0, realizations = 1;
    uint32_t first_realization = 0;
    uint64_t seed = 0;
    int32_t bins = 1;
    double dead_time = 0.0;                 // periods
    const uint32_t* pixel_index = nullptr;  // (pixels): names the random streams
    const int64_t* place = nullptr;         // (pixels): of the pixel in an image of the output
    int64_t image = 0;                      // pixels of an image of the output
    const float* shapes = nullptr;          // (rows, bins), each summing to 1
    const int64_t* rows = nullptr;          // (pixels, 4)
    const double* weights = nullptr;        // (pixels, 4)
    const double* shift = nullptr;          // (pixels) periods, [0, 1); null: rows are at the pixels' own delays
    const double* signal = nullptr;         // (pixels) photons per period; with `shift` only; likewise below
    const double* background = nullptr;
    const double* rate = nullptr;  // (pixels) mean registrations per period
    PulseFrame frame;
    const RowGuide* guides = nullptr;  // (rows); null: no photons one by one
    const int64_t* counts = nullptr;   // (realizations, pixels)
};

constexpr uint64_t kShapeDomain = 0x5368617065730000u;  // "Shapes": not another engine's numbers at one seed

constexpr int64_t kShapeStep = 64;  // bins that are drawn together

// Bins j, j + classes, j + 2 classes, ... are a class: photons find their class first, then their bin in it. About
// as many classes as bins in each, in steps of 64.
static inline constexpr int64_t shape_classes(int64_t bins) {
    int64_t classes = kShapeStep;
    while (classes * classes < 4 * bins) classes *= 2;
    return classes;
}
static inline constexpr int64_t padded_bins(int64_t bins) {
    const int64_t classes = shape_classes(bins);
    return (bins + classes - 1) / classes * classes;
}

// Bins outside of the frame in a part of a guide, as a power of two.
static inline constexpr int guide_shift(int64_t outside) {
    int shift = 0;
    while (static_cast<int64_t>(kParts) << shift < outside) ++shift;
    return shift;
}

// Bins on either side of the frame that a dead time of `offset` bins, whole periods apart, reaches.
static inline int64_t frame_reach(double offset) { return static_cast<int64_t>(offset < 0 ? -offset : offset) + 2; }

}  // namespace mars
