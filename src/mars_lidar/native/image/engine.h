// Depth from a few photons a pixel, stage by stage, on threads (docs/theory_reconstruction.md, section 7). Delays in cells.
#pragma once
#include <cstdint>
#include <vector>

#include "base/parallel.h"
#include "image/kernel.h"
#include "reconstruct/histogram_record.h"

namespace mars {

// The registrations of an image, by pixel: those of pixel p are first[p] .. first[p + 1].
struct ImagePhotons {
    int64_t height, width;
    const int64_t* first;  // (pixels + 1)
    const int32_t* bin;
    const float* number;
    const float*
        counted;  // of them, those that are not of another surface; the others blinded the detector all the same
};

// A rectangle of the image: rows [y0, y1), columns [x0, x1).
struct ImagePart {
    int64_t y0, y1, x0, x1;

    int64_t pixels() const { return (y1 - y0) * (x1 - x0); }
};

// The pulse about a delay as a curve: density in multiples of uniform light, and score: the shift of the delay that a photon
// there asks for, of unit slope on average; at low + (j + 1/2) / phases cells after the delay.
struct PulseScore {
    int phases;
    int64_t count;
    float low;
    const float *density, *score;
    float near_low, near_high;  // the window about the delay in which signal is counted
};

constexpr int kImagePhases = 32;  // of a photon within its cell

// What is known of the system: see ImagePulse, PulseScore. `density` of a registration about its delay, in multiples of
// uniform light, and `score`, in periods: sample j lies (first + j + 1/2) / kImagePhases cells after the delay.
struct ImageSetting {
    ImageSetting(const HistogramRecord& record, int cells, int64_t first, const std::vector<double>& density,
                 const std::vector<double>& score, double sigma);
    ImageSetting(const ImageSetting&) = delete;
    ImageSetting& operator=(const ImageSetting&) = delete;

    const HistogramRecord* recording;
    int cells;
    double sigma;         // standard deviation of a photon's time, cells
    double near, inside;  // cells of the window in which signal is counted, and the share of the signal there
    ImagePulse pulse;
    PulseScore score;
    float least;  // exposure of a pulse, relative to background's, below which a delay is excluded

 private:
    std::vector<float> curve_, score_, table_;
};

constexpr int kImageColumns = 5;  // of image_centroids

// Likelihoods (pixels of the part, cells) of mean 1. `ratio` (pixels of the image): signal to background photons expected.
void image_likelihood(const ImageSetting& setting, const ImagePhotons& photons, const ImagePart& part,
                      const float* ratio, float* out, int threads, const Watch& watch);

// Both combs of an image (height, width, cells): `one` becomes the posterior, `other` its sums over 17 cells.
void image_posterior(const float* likelihood, float* one, float* other, int64_t height, int64_t width, int cells,
                     const ImageLine& step, int peaks, float* place, float* mass, bool broad, int threads,
                     const Watch& watch);

// As ImageCandidates says, of whose pointers only `scratch` is not given.
void image_candidates(const ImageCandidates& task, int threads, const Watch& watch);

// Of each pixel (pixels, 5): signal photons about the delay, their centroid less the delay after so many steps, exposure of a
// pulse there and of background, as shares of all cycles, and photons within the pulse's window.
void image_centroids(const ImageSetting& setting, const ImagePhotons& photons, const float* ratio, const float* delay,
                     int steps, float* out, int threads, const Watch& watch);

// Rows [first, last) of planes, into (rows, width, windows, 7).
void image_planes(const ImagePlanes& task, int64_t first, int64_t last, int threads, const Watch& watch);

// A whole image (outputs, height, width) of a convolution.
void image_convolution(const ImageConvolution& task, int64_t height, int threads, const Watch& watch);

}  // namespace mars
