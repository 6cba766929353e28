// Depth and signal of an image from a few photons a pixel, from its registrations to its maps
// (docs/theory_reconstruction.md, section 7): what Python and the explorer's page call. Delays in cells.
#pragma once
#include <cstdint>
#include <vector>

#include "base/parallel.h"
#include "image/engine.h"

namespace mars {

constexpr int kImagePeaks = 5;  // of the posterior, among which the first network chooses
constexpr int kImageWindows = 5;
constexpr int32_t kImageRadii[kImageWindows] = {1, 2, 3, 5,
                                                8};  // pixels that a window of the planes reaches to each side
constexpr int kImageOffsets = 41;  // pixels around whose posteriors the first network reads: see image_offsets
constexpr int kImageHidden = 40, kImageChannels = 32;  // of the two networks
constexpr int kImageCandidateFeatures = 3 * kImageOffsets + 3;
constexpr int kImageDelays = kImageWindows + 1, kImageSignals = kImageWindows + 2;  // that the second network weighs
constexpr int kImagePlaneFeatures = 5 * kImageWindows + 9, kImageOutputs = kImageDelays + kImageSignals + 5;

// Prior of the step to the next pixel: Gaussian of so many sigma of the pulse; shares within 15 cells, and to anywhere.
constexpr float kImageStepSigma = 0.5f, kImageWide = 0.3f, kImageJump = 0.15f;
constexpr float kImageSettled = 0.98f;  // posterior mass of the largest peak, above which there is nothing to choose
constexpr double kImageLevel = 0.9;     // of the intervals
constexpr double kImageBright = 200.0;  // signal photons, from which on a pixel's own likelihood is as good
constexpr double kImageOutlierSigma = 3.0;  // errors from here on are outliers

// Rows down and columns to the right of the pixels that the first network reads: 5 x 5, and 3 x 3 with steps of 4 and 8.
struct ImageOffsets {
    int32_t down[kImageOffsets], right[kImageOffsets];
    ImageOffsets();
};

// Both networks, and where they hold.
struct ImageNetworks {
    static constexpr int kChoose = (kImageCandidateFeatures + 1) * kImageHidden + (kImageHidden + 1) * kImageHidden +
                                   kImageHidden + 1 + 3;  // as ImageCandidates takes them
    // layers enter (1 x 1), first and second (3 x 3), leave (1 x 1): weights (inputs, rows, columns, outputs) and bias each
    static constexpr int kWeigh = (kImagePlaneFeatures + 1) * kImageChannels +
                                  2 * (9 * kImageChannels + 1) * kImageChannels + (kImageChannels + 1) * kImageOutputs;
    std::vector<float> weights;  // kChoose + kWeigh; kChoose alone while the second is not trained
    // of the half widths: factor (1 + background photons about the delay)^exponent
    double interval_factor = 1.0, interval_exponent = 0.0;
    double limits[4][2] = {};  // least and largest signal photons a pixel, signal to background, cells, pixels a side

    bool hold_for(double signal, double background, int cells, int64_t side) const;
};

// Outputs (outputs, rows, width) of the second network for features (features, rows, width).
std::vector<float> image_weigh(const float* features, int64_t rows, int64_t width, const float* weights, int threads,
                               const Watch& watch);

// Of each pixel: signal and background of an exposure that is never blind, of a pixel of mean efficiency; no registration
// though those around have some.
struct ImageLight {
    std::vector<double> signal, background;
    std::vector<uint8_t> missing;
};

// Of each pixel: delay, confidence, posterior within 3 cells and its spread there, and within 8 cells.
struct ImageChoice {
    std::vector<float> delay, confidence, mass, spread, broad;
};

// Of each pixel: signal photons about its delay, their centroid less it, exposure.
struct ImagePhotometry {
    std::vector<float> number, offset, exposure;
};

// Of a part of the image (pixels, cells): posterior, its sums over 17 cells, likelihood; (pixels, peaks) its peaks.
struct ImageVolumes {
    std::vector<float> posterior, broad, likelihood, place, mass;
};

// Of rows of an image, each (.., rows, width): what the second network reads, and the delays, in sigma, and logarithms of
// signals that it weighs.
struct ImagePlaneFeatures {
    std::vector<float> features, delays, log_signals;
};

// Maps that come out, (pixels) each, one after the other; delays in periods, light in photons a period.
enum ImageMap {
    kImageDelay,
    kImageHalfWidth,  // of the interval; NaN where none is stated
    kImageDeviation,  // of the delay; likewise
    kImageOutlier,    // probability that the delay is another surface's
    kImageSignal,
    kImageSignalError,
    kImageBackground,
    kImageNumber,  // signal photons about the delay
    kImageMaps
};

class ImageSolver {
 public:
    // `efficiency` (pixels): of each, relative to the mean; null: all alike. `volume_bytes`: of each of three volumes, beyond
    // which an image is done in parts that overlap. `block_pixels`: of the second network at a time.
    ImageSolver(const ImagePhotons& photons, const double* efficiency, int64_t volume_bytes, int64_t block_pixels,
                int threads);

    void begin(const ImageSetting& setting, const Watch& watch);     // the light, from a first round of delays
    void choose(const ImageNetworks* networks, const Watch& watch);  // the delays; null: the largest peaks
    void refine(const ImageSetting& finer, const Watch& watch);      // the chosen delays, of a pulse blurred less
    void look(const Watch& watch);                                   // light and photometry at the chosen delays
    // `maps` (kImageMaps, pixels) and flags (pixels).
    void estimate(const ImageNetworks* networks, double* maps, uint8_t* flags, const Watch& watch);
    // All of it; `settings`: from the widest blur to none.
    void solve(const std::vector<const ImageSetting*>& settings, const ImageNetworks* networks, double* maps,
               uint8_t* flags, const Watch& watch);

    // The steps between, for training and tests.
    void volumes(const ImagePart& part, int peaks, ImageVolumes* out, const Watch& watch) const;
    void candidate_features(const ImageVolumes& of, const std::vector<int64_t>& pixel, float* out,
                            const Watch& watch) const;
    ImagePlaneFeatures plane_features(int64_t first, int64_t last, const Watch& watch) const;
    ImagePart whole() const { return {0, photons_.height, 0, photons_.width}; }
    int64_t pixels() const { return photons_.height * photons_.width; }
    int64_t parts() const { return static_cast<int64_t>(cuts().size()); }
    const ImageLight& light() const { return light_; }
    float background_near(int64_t p) const;  // photons of background in 5 sigma
    const ImageChoice& chosen() const { return chosen_; }

 private:
    struct Cut {
        ImagePart part, kept;
    };
    struct Window {  // a window of the planes: offset and its error in sigma, signal and its photons
        float offset, error, signal, light;
    };

    double efficiency(int64_t p) const { return efficiency_ ? efficiency_[p] : 1.0; }
    std::vector<Cut> cuts() const;
    double signal_share() const;
    std::vector<double> background_of(const std::vector<double>& count, const std::vector<double>& exposure) const;
    std::vector<float> ratio() const;
    std::vector<float> centroids(const float* delay, int steps, const Watch& watch) const;
    void first_light();
    void light_at(const float* delay, const Watch& watch);
    void photometry(const Watch& watch);
    std::vector<float> planes(int64_t first, int64_t last, const Watch& watch) const;
    Window agreeing(int64_t p, const float* plane) const;
    ImageCandidates candidates(const ImageVolumes& of, const ImagePart& part, const float* signal) const;
    std::vector<float> signal_of(const ImagePart& part) const;
    template <class Each>
    void in_blocks(const Each& each) const;

    const ImagePhotons photons_;
    const double* efficiency_;
    const int64_t volume_bytes_, block_pixels_;
    const int threads_;
    const ImageSetting* setting_ = nullptr;
    std::vector<double> total_;
    ImageLight light_;
    ImageChoice chosen_;
    ImagePhotometry seen_;
};

// Delays (height, width), in periods, of which those to `fill` become the median of the others within two pixels, borders
// first; without others they stay.
void image_fill(double* delay, const uint8_t* fill, int64_t height, int64_t width);

}  // namespace mars
