// Histograms from a count and a shape, one function per vector level (shape_kernel.cpp is compiled once for each).
//
// The registrations of an exposure are N draws from the shape: Multinomial(N, pi), with N given. The shape of a
// pixel is a mixture of rows of a table, moved by the pixel's delay to a fraction of a bin (shape_alignment.h).
#pragma once
#include <atomic>
#include <cstdint>

#include "lanes/levels.h"
#include "mars/shape_job.h"

namespace mars {

// Consecutive pixels in consecutive realizations.
struct ShapeBlock {
    const ShapeJob* job;
    int64_t pixel, pixels, realization, realizations;
    bool wide;        // the output is uint32, not uint16
    void* out;        // (realizations, image, bins)
    double* aligned;  // (pixels, bins): not histograms, but the shapes that they would be drawn from; or null
    void* memory;     // `shape_memory` bytes, aligned to 64
    // Poisson number of a mean beyond those of the lanes
    int64_t (*large_poisson)(uint64_t key, uint32_t event, uint32_t step, double mean);
    const std::atomic<bool>* stop;
    bool full;  // result: a bin would have exceeded the output's type
};

// Functions of this header have internal linkage: one compiled for AVX-512 must not be linked in place of another.

MARS_DECLARE_KERNEL(void, shape_kernel_, ShapeBlock& block)

// Work area of one thread: six arrays of the bins, the classes, the frame, and photons on their way.
int64_t shape_memory(const ShapeJob& job);

}  // namespace mars
