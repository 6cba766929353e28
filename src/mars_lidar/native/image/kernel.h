// The inner loops of depth from a few photons a pixel (docs/theory_reconstruction.md, section 7), compiled once per vector
// level (lanes/levels.h). They allocate nothing: image/engine.cpp lends `scratch`, whose size is stated at each.
// Delays are in cells, of which a period has `cells`, a multiple of 16.
#pragma once
#include <cstdint>

#include "lanes/levels.h"

namespace mars {

constexpr int kImageLanes = 16;  // numbers side by side, at every level, so that sums have the same order
constexpr int kImageFactors =
    3;  // ratios of signal to background about a pixel's own, over which its likelihood averages
constexpr int kImageMoments = 7;  // of a plane: see image_planes

// The pulse about a delay, in multiples of uniform light: density[phase * span + k] of a photon at place (phase + 1/2) /
// phases within its cell, for a delay at the middle of the cell first + k further.
struct ImagePulse {
    int phases, first, span;
    float top;  // the largest
    const float* density;
};

// Likelihood (cells) of the delay of one pixel, of mean 1. Scratch: 6 (cells + span).
struct ImagePixel {
    const ImagePulse* pulse;
    int cells;
    int64_t photons;             // entries of time and weight
    const float *time, *weight;  // place in cells, number of photons there
    float ratio;                 // signal photons to background photons, expected of a pixel always armed
    const float* armed;          // (cells) exposure of a pulse at each delay over that of background; null: 1
    float least;                 // of `armed`: delays below it are excluded
    float *scratch, *out;
};

// From the likelihoods of a line of pixels, messages to each from both sides times its own, normalised. Scratch:
// (count + 2) cells + 6 (cells + 64).
struct ImageLine {
    const float* in;
    float* out;  // may be `in`
    int64_t count, stride;
    int cells;
    float narrow[4], wide, jump;  // shares of a step to the next pixel: by 0, 1, 2, 3 cells; within 15 cells; anywhere
    float* scratch;
};

// Both combs of `count` pixels into their posterior, in `one`; and its `peaks` largest peaks. `broad` (may be `other`)
// becomes its sum over 17 cells. Scratch: 3 cells + 64.
struct ImagePosterior {
    float *one, *other;
    int64_t count;
    int cells, peaks;
    float *place, *mass;  // (count, peaks): in cells, and the posterior within 2 cells
    bool broad;
    float* scratch;
};

// Candidates of 16 / peaks .. pixels at a time: features of each, and what a network makes of them.
struct ImageCandidates {
    const float *posterior, *broad, *likelihood;  // (height, width, cells)
    int64_t height, width;
    int cells, peaks;
    const float *place, *mass, *signal;  // (pixels, peaks), (pixels, peaks), (pixels)
    const int64_t* pixel;                // the pixels to do
    int64_t count;
    const int32_t *down, *right;  // (offsets)
    int offsets;
    float* features;  // (count, peaks, 3 offsets + 3), or null
    // weights, each (inputs, outputs) row by row with its bias: 3 offsets + 3 -> hidden -> hidden -> 1, and 2 -> 1
    const float* weights;
    int hidden;
    int32_t* chosen;    // (count)
    float* confidence;  // (count): probability of the chosen one
    float* scratch;     // 16 (3 offsets + 3 + 2 hidden)
};

// Planes through the photons of windows that grow, for the pixels [first, last) of row y.
struct ImagePlanes {
    // of images (height, width) with a margin of `margin` pixels at each side and 16 more to the right: photons of signal,
    // their centroid less the delay, the delay, exposure (0: no pixel)
    const float *number, *offset, *delay, *exposure;
    int64_t width, margin, y, first, last;
    float cells, sigma;
    const int32_t* radii;
    int windows;
    float* out;  // (pixels of the row, windows, 7)
};

// A convolution of one row, 3 x 3 or 1 x 1, of `inputs` planes with a margin of one pixel and 16 more to the right.
struct ImageConvolution {
    const float* in;
    int64_t plane, pitch;  // floats from plane to plane and from row to row of `in`
    int64_t y, width;
    int inputs, outputs, side;
    bool rectified;               // negative inputs count as 0
    const float *weights, *bias;  // (inputs, side, side, outputs), (outputs)
    float* out;                   // (outputs, ...), `out_plane` from plane to plane
    int64_t out_plane;
};

MARS_DECLARE_KERNEL(void, image_likelihood_, const ImagePixel&)
MARS_DECLARE_KERNEL(void, image_line_, const ImageLine&)
MARS_DECLARE_KERNEL(void, image_posterior_, const ImagePosterior&)
MARS_DECLARE_KERNEL(void, image_candidates_, const ImageCandidates&)
MARS_DECLARE_KERNEL(void, image_planes_, const ImagePlanes&)
MARS_DECLARE_KERNEL(void, image_convolution_, const ImageConvolution&)

}  // namespace mars
