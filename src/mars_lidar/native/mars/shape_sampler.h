// Multinomial histograms from counts and shapes: N draws from a pixel's shape, the mixture of rows of a table moved to its own
// delay (docs/theory_mars.md).
#pragma once
#include <cstddef>
#include <cstdint>
#include <string>

#include "base/parallel.h"
#include "mars/shape_job.h"

namespace mars {

// Histograms out (realizations, image, bins) of `counts` (realizations, pixels); std::overflow_error where a bin does not
// fit. `level` forces a vector level; empty: the widest. For uint16_t and uint32_t.
template <class Count>
void shape_histogram(const ShapeJob& job, const int64_t* counts, Count* out, int threads, const std::string& level,
                     const Watch& watch);

// The shapes out (pixels, bins) from which a job's histograms are drawn.
void shape_aligned(const ShapeJob& job, double* out, const std::string& level);

// What the photons drawn one by one need of a row: least and largest values in the parts of it outside of the frame, and
// its sum over the dead time before the frame.
void look_at_row(const ShapeJob& job, int64_t row, RowGuide& guide);

// The same of the rows that a job's pixels use, of `rows` in all, where it is missing.
void look_at_rows(const ShapeJob& job, RowGuide* guides, size_t rows, int threads, const Watch& watch);

}  // namespace mars
