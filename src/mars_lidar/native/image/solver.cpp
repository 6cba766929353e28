// From the registrations of an image to its maps: image/solver.h says what each step does.
#include "image/solver.h"

#include <algorithm>
#include <cmath>
#include <complex>
#include <limits>

#include "reconstruct/pixel_flags.h"

namespace mars {
namespace {

constexpr int64_t kOverlap = 24;  // pixels that parts reach into each other: messages from beyond weigh 0.85^24 at most
constexpr int kSurroundings = 5;  // pixels a side, over which signal is averaged
constexpr int kBackgroundSide = 9;  // pixels a side, over which background is averaged
constexpr int kFactors = 6;         // hot pixels: how often a pixel's background is so many times that around it
constexpr double kHot[kFactors] = {1.0, 4.0, 16.0, 64.0, 256.0, 1024.0},
                 kHotShare[kFactors] = {0.98, 0.01, 0.004, 0.002, 0.002, 0.002};
constexpr double kMissing =
    1e-4;  // chance of no registration, by the pixels around, below which a pixel counts as missing
constexpr double kLeastLight = 0.02;  // photons a pixel and exposure: less counts as so much
constexpr int64_t kSurvey = 65536;    // pixels, of which the share of signal is taken at first
constexpr int64_t kMargin = kImageRadii[kImageWindows - 1];
constexpr float kKappa = 1.2f;  // standard errors to either side, in which windows of all sizes must agree
constexpr float kOwn = 20.0f;   // signal photons of a pixel, from which on it is a window of its own
constexpr double kScale =
    1.05;  // of a Laplace distribution, in the error of the untrained method: measured, studies/image
constexpr double kFilledAbove = 0.5;   // probability of an outlier, from which on a pixel is filled
constexpr double kGaussianNear = 2.5;  // sigma to either side, in which signal of a Gaussian pulse is counted
constexpr int64_t kReach = 2;          // pixels that the second network reads to each side
constexpr double kTurn = 6.283185307179586;
constexpr double kNone = std::numeric_limits<double>::quiet_NaN();

using Map = std::vector<double>;

// x modulo `period`, from 0 on.
template <class Number>
Number wrapped(Number x, Number period) {
    const Number y = std::fmod(x, period);
    return y < 0 ? y + period : y;
}

template <class Number>
Number clipped(Number x, Number low, Number high) {
    return std::min(std::max(x, low), high);
}

// Means over `side` x `side` pixels; beyond a border lies what is at it.
Map mean_around(const Map& values, int64_t height, int64_t width, int side) {
    const int64_t reach = side / 2;
    Map lines(values.size(), 0.0), out(values.size());
    for (int64_t y = 0; y < height; ++y) {
        double* const to = lines.data() + y * width;
        for (int64_t d = -reach; d <= reach; ++d) {
            const double* const from = values.data() + clipped<int64_t>(y + d, 0, height - 1) * width;
            for (int64_t x = 0; x < width; ++x) to[x] += from[x] / side;
        }
    }
    for (int64_t y = 0; y < height; ++y)
        for (int64_t x = 0; x < width; ++x) {
            double sum = 0.0;
            for (int64_t d = -reach; d <= reach; ++d) sum += lines[y * width + clipped<int64_t>(x + d, 0, width - 1)];
            out[y * width + x] = sum / side;
        }
    return out;
}

double median(Map values) {
    const auto middle = values.begin() + static_cast<int64_t>(values.size() / 2);
    std::nth_element(values.begin(), middle, values.end());
    return values.size() % 2 ? *middle : 0.5 * (*middle + *std::max_element(values.begin(), middle));
}

// Half width of the interval that holds a delay of Laplace error with probability 1 - doubt, anywhere else otherwise.
double laplace_half(double scale, double doubt) {
    const double room = 1.0 - kImageLevel - doubt;
    return room > 0.05 * (1.0 - kImageLevel) ? scale * std::log((1.0 - doubt) / room) : kNone;
}

// Weights exp(x - max) over their sum, of `count` outputs `step` apart.
void softmax(const float* x, int count, int64_t step, double* weight) {
    double most = -HUGE_VAL, total = 0.0;
    for (int k = 0; k < count; ++k) most = std::max(most, static_cast<double>(x[k * step]));
    for (int k = 0; k < count; ++k) total += weight[k] = std::exp(static_cast<double>(x[k * step]) - most);
    for (int k = 0; k < count; ++k) weight[k] /= total;
}

std::vector<float> convolved(const float* in, int inputs, int64_t rows, int64_t width, const float** weights,
                             int outputs, int side, bool rectified, int threads, const Watch& watch) {
    const int64_t pitch = width + 2 + kImageLanes, plane = (rows + 2) * pitch;
    std::vector<float> padded(static_cast<size_t>(inputs) * plane, 0.0f);
    for (int i = 0; i < inputs; ++i)
        for (int64_t y = 0; y < rows + 2; ++y) {
            const float* const from = in + (i * rows + clipped<int64_t>(y - 1, 0, rows - 1)) * width;
            float* const to = padded.data() + i * plane + y * pitch;
            to[0] = from[0];
            std::copy(from, from + width, to + 1);
            to[width + 1] = from[width - 1];
        }
    std::vector<float> out(static_cast<size_t>(outputs) * rows * width);
    ImageConvolution task{};
    task.in = padded.data();
    task.plane = plane;
    task.pitch = pitch;
    task.width = width;
    task.inputs = inputs;
    task.outputs = outputs;
    task.side = side;
    task.rectified = rectified;
    task.weights = *weights;
    task.bias = *weights + static_cast<int64_t>(inputs) * side * side * outputs;
    task.out = out.data();
    task.out_plane = rows * width;
    image_convolution(task, rows, threads, watch);
    *weights = task.bias + outputs;
    return out;
}

}  // namespace

ImageOffsets::ImageOffsets() {
    int k = 0;
    const auto add = [&](int y, int x) {
        down[k] = y;
        right[k++] = x;
    };
    for (int y = -2; y <= 2; ++y)
        for (int x = -2; x <= 2; ++x) add(y, x);
    for (const int step : {4, 8})
        for (int y = -1; y <= 1; ++y)
            for (int x = -1; x <= 1; ++x)
                if (y != 0 || x != 0) add(step * y, step * x);
}

bool ImageNetworks::hold_for(double signal, double background, int cells, int64_t side) const {
    const double given[4] = {signal, signal / std::max(background, 1e-9), static_cast<double>(cells),
                             static_cast<double>(side)};
    bool all = true;
    for (int k = 0; k < 4; ++k) all = all && limits[k][0] <= given[k] && given[k] <= limits[k][1];
    return all;
}

std::vector<float> image_weigh(const float* features, int64_t rows, int64_t width, const float* weights, int threads,
                               const Watch& watch) {
    const auto layer = [&](const float* in, int inputs, int outputs, int side) {
        return convolved(in, inputs, rows, width, &weights, outputs, side, inputs == kImageChannels, threads, watch);
    };
    std::vector<float> f = layer(features, kImagePlaneFeatures, kImageChannels, 1);
    for (int k = 0; k < 2; ++k) {
        const std::vector<float> more = layer(f.data(), kImageChannels, kImageChannels, 3);
        for (size_t i = 0; i < f.size(); ++i) f[i] += more[i];
    }
    return layer(f.data(), kImageChannels, kImageOutputs, 1);
}

ImageSolver::ImageSolver(const ImagePhotons& photons, const double* efficiency, int64_t volume_bytes,
                         int64_t block_pixels, int threads)
    : photons_(photons),
      efficiency_(efficiency),
      volume_bytes_(volume_bytes),
      block_pixels_(block_pixels),
      threads_(threads),
      total_(photons.height * photons.width, 0.0) {
    for (int64_t p = 0; p < pixels(); ++p)
        for (int64_t e = photons.first[p]; e < photons.first[p + 1]; ++e)
            total_[p] += static_cast<double>(photons.counted[e]);
}

void ImageSolver::solve(const std::vector<const ImageSetting*>& settings, const ImageNetworks* networks, double* maps,
                        uint8_t* flags, const Watch& watch) {
    begin(*settings[0], watch);
    double signal = 0.0, background = 0.0, here = 0.0;
    for (int64_t p = 0; p < pixels(); ++p) {
        if (light_.missing[p]) continue;
        signal += light_.signal[p];
        background += light_.background[p];
        here += 1.0;
    }
    if (networks && !(here > 0.0 && networks->hold_for(signal / here, background / here, settings.back()->cells,
                                                       std::min(photons_.height, photons_.width))))
        networks = nullptr;
    choose(networks, watch);
    for (size_t k = 1; k < settings.size(); ++k) refine(*settings[k], watch);
    look(watch);
    estimate(networks, maps, flags, watch);
}

void ImageSolver::begin(const ImageSetting& setting, const Watch& watch) {
    setting_ = &setting;
    first_light();
    std::vector<float> delay(pixels());
    ImageVolumes of;
    for (const Cut& cut : cuts()) {
        volumes(cut.part, 1, &of, watch);
        const ImagePart &part = cut.part, &kept = cut.kept;
        for (int64_t y = kept.y0; y < kept.y1; ++y)
            for (int64_t x = kept.x0; x < kept.x1; ++x)
                delay[y * photons_.width + x] = of.place[(y - part.y0) * (part.x1 - part.x0) + x - part.x0];
    }
    light_at(delay.data(), watch);
}

// They do not depend on the machine.
std::vector<ImageSolver::Cut> ImageSolver::cuts() const {
    const int64_t most = volume_bytes_ / (4 * setting_->cells);
    if (pixels() <= most) return {{whole(), whole()}};
    const int64_t side = std::max<int64_t>(static_cast<int64_t>(std::sqrt(static_cast<double>(most))), kOverlap);
    const int64_t overlap = std::min(kOverlap, side / 4);
    const auto pieces = [&](int64_t length) {  // of about `side`, and the part of each that is kept
        std::vector<ImagePart> out;
        if (length <= side) return std::vector<ImagePart>{{0, length, 0, length}};
        const int64_t number = (length + side - 2 * overlap - 1) / (side - 2 * overlap);
        for (int64_t k = 0; k < number; ++k) {
            const int64_t low = length * k / number, high = length * (k + 1) / number;
            out.push_back({std::max<int64_t>(0, low - overlap), std::min(length, high + overlap), low, high});
        }
        return out;
    };
    std::vector<Cut> out;
    for (const ImagePart& rows : pieces(photons_.height))
        for (const ImagePart& columns : pieces(photons_.width))
            out.push_back({{rows.y0, rows.y1, columns.y0, columns.y1}, {rows.x0, rows.x1, columns.x0, columns.x1}});
    return out;
}

// Of the photons, from coincidences between neighbours.
double ImageSolver::signal_share() const {
    const int64_t height = photons_.height, width = photons_.width, bins = setting_->recording->bins;
    const int slots = static_cast<int>(clipped(setting_->cells / setting_->sigma / 2.0, 4.0, 256.0));
    const int64_t rows = std::max<int64_t>(2, std::min(height, kSurvey / width));
    const int64_t number = std::max<int64_t>(1, std::min(rows / 2, height / 2));
    double together = 0.0, pairs = 0.0;
    std::vector<double> v(2 * width * slots), near(v.size()), total(2 * width);
    for (int64_t k = 0, last = -1; k < number; ++k) {
        const int64_t far = std::max<int64_t>(height - 2, 0), y = number == 1 ? 0 : k * far / (number - 1);
        if (y == last) continue;
        last = y;
        const int64_t lines = std::min<int64_t>(2, height - y), here = lines * width;
        std::fill(v.begin(), v.end(), 0.0);
        for (int64_t p = 0; p < here; ++p) {
            double* const to = v.data() + p * slots;
            total[p] = total_[y * width + p];
            for (int64_t e = photons_.first[y * width + p]; e < photons_.first[y * width + p + 1]; ++e)
                to[std::min<int64_t>(photons_.bin[e] * int64_t{slots} / bins, slots - 1)] +=
                    static_cast<double>(photons_.counted[e]);
            for (int s = 0; s < slots; ++s)
                near[p * slots + s] = to[s] + 0.5 * (to[s == 0 ? slots - 1 : s - 1] + to[s == slots - 1 ? 0 : s + 1]);
        }
        const auto pair = [&](int64_t p, int64_t q) {
            for (int s = 0; s < slots; ++s) together += v[p * slots + s] * near[q * slots + s];
            pairs += total[p] * total[q];
        };
        for (int64_t p = 0; p < here; ++p) {
            if (p % width > 0) pair(p, p - 1);
            if (p >= width) pair(p, p - width);
        }
    }
    if (pairs == 0.0) return 0.5;
    const double by_chance = 2.0 / slots;
    // 0.8 of the pairs of signal from one surface lie in the same slot or, by half, in the next
    return std::sqrt(clipped((together / pairs - by_chance) / (0.8 - by_chance), 1e-3, 0.9));
}

// Before any delay is known: one share of signal, background as the pixels have photons.
void ImageSolver::first_light() {
    const int64_t height = photons_.height, width = photons_.width;
    light_.missing.assign(pixels(), 0);
    for (int64_t p = 0; p < pixels(); ++p) light_.missing[p] = efficiency(p) == 0.0;
    if (std::min(height, width) >= 2) {
        const double most = 4.0 * median(total_) + 4.0;
        Map present(pixels()), count(pixels());
        for (int64_t p = 0; p < pixels(); ++p) {
            present[p] = total_[p] > 0.0 ? 1.0 : 0.0;
            count[p] = std::min(total_[p], most);
        }
        present = mean_around(present, height, width, kSurroundings);
        count = mean_around(count, height, width, kSurroundings);
        for (int64_t p = 0; p < pixels(); ++p)
            if (total_[p] == 0.0 && std::exp(-0.5 * count[p] / std::max(present[p], 1e-3) * efficiency(p)) < kMissing)
                light_.missing[p] = 1;
    }
    const double share = signal_share();
    Map rest(pixels()), exposure(pixels());
    double photons = 0.0, exposed = 0.0;
    for (int64_t p = 0; p < pixels(); ++p) {
        rest[p] = (1.0 - share) * total_[p];
        exposure[p] = light_.missing[p] ? 0.0 : efficiency(p);
        exposed += exposure[p];
        if (!light_.missing[p]) photons += total_[p];
    }
    light_.background = background_of(rest, exposure);
    light_.signal.assign(pixels(), std::max(share * photons / std::max(exposed, 1e-9), kLeastLight));
}

// Background of a full exposure: that around, or of a hot pixel, where its counts ask for it, its own: the posterior mean
// over the factors `kHot`, of Poisson counts.
std::vector<double> ImageSolver::background_of(const Map& count, const Map& exposure) const {
    const int64_t height = photons_.height, width = photons_.width;
    const double usual = 4.0 * median(count) + 4.0;
    Map out(count);
    for (double& x : out) x = std::min(x, usual);
    out = mean_around(out, height, width, kBackgroundSide);
    const Map open = mean_around(exposure, height, width, kBackgroundSide);
    double mean = 0.0;
    for (int64_t p = 0; p < pixels(); ++p) {
        out[p] /= std::max(open[p], 1e-6);
        mean += out[p];
    }
    mean = std::max(mean / static_cast<double>(pixels()), 1e-6);
    for (int64_t p = 0; p < pixels(); ++p) {
        const double around = out[p] = std::max(out[p], 1e-3 * mean), expected = around * exposure[p], n = count[p];
        if (!(n > expected + 4.0 * std::sqrt(expected) + 2.0)) continue;
        double log_weight[kFactors], most = -HUGE_VAL, total = 0.0;
        for (int k = 0; k < kFactors; ++k) {
            const double of = expected * kHot[k] + 1e-9;
            log_weight[k] = std::log(kHotShare[k]) + n * std::log(of) - of;
            most = std::max(most, log_weight[k]);
        }
        for (const double x : log_weight) total += std::exp(x - most);
        const double usual_weight = std::exp(log_weight[0] - most) / total;
        // between the factors: a Gamma of the count's own spread about it
        out[p] = usual_weight * around + (1.0 - usual_weight) * n / std::max(exposure[p], 1e-6);
    }
    return out;
}

std::vector<float> ImageSolver::ratio() const {
    std::vector<float> out(pixels());
    for (int64_t p = 0; p < pixels(); ++p)
        out[p] = static_cast<float>(light_.signal[p] / std::max(light_.background[p], kLeastLight));
    return out;
}

std::vector<float> ImageSolver::centroids(const float* delay, int steps, const Watch& watch) const {
    std::vector<float> out(pixels() * kImageColumns);
    image_centroids(*setting_, photons_, ratio().data(), delay, steps, out.data(), threads_, watch);
    return out;
}

void ImageSolver::light_at(const float* delay, const Watch& watch) {
    const int64_t height = photons_.height, width = photons_.width;
    const double share = setting_->near / setting_->cells;
    Map count(pixels()), closed(pixels()), exposed(pixels()), near(pixels());
    {
        const std::vector<float> columns = centroids(delay, 1, watch);
        for (int64_t p = 0; p < pixels(); ++p) {
            const float* const of = columns.data() + p * kImageColumns;
            const double open = light_.missing[p] ? 0.0 : efficiency(p);
            exposed[p] = open * static_cast<double>(of[2]);
            closed[p] = open * static_cast<double>(of[3]) * (1.0 - share);
            near[p] = static_cast<double>(of[4]);
            count[p] = std::max(total_[p] - near[p], 0.0);
        }
    }
    light_.background = background_of(count, closed);
    for (int64_t p = 0; p < pixels(); ++p)
        near[p] = exposed[p] > 0.0 ? near[p] - light_.background[p] * share * exposed[p] : 0.0;
    near = mean_around(near, height, width, kSurroundings);
    exposed = mean_around(exposed, height, width, kSurroundings);
    for (int64_t p = 0; p < pixels(); ++p)
        light_.signal[p] = std::max(near[p] / std::max(exposed[p], 1e-6) / setting_->inside,
                                    0.1 * light_.background[p] * share + kLeastLight);
}

void ImageSolver::volumes(const ImagePart& part, int peaks, ImageVolumes* out, const Watch& watch) const {
    const int n = setting_->cells;
    const size_t size = static_cast<size_t>(part.pixels()) * n;
    for (std::vector<float>* each : {&out->posterior, &out->broad, &out->likelihood}) each->resize(size);
    for (std::vector<float>* each : {&out->place, &out->mass}) each->resize(part.pixels() * peaks);
    image_likelihood(*setting_, photons_, part, ratio().data(), out->likelihood.data(), threads_, watch);
    ImageLine step{};
    double tap[4], total = 0.0;
    for (int k = 0; k < 4; ++k) {
        const double u = k / (static_cast<double>(kImageStepSigma) * setting_->sigma);
        tap[k] = std::exp(-0.5 * u * u);
        total += k == 0 ? tap[k] : 2.0 * tap[k];
    }
    for (int k = 0; k < 4; ++k) step.narrow[k] = static_cast<float>(tap[k] / total);
    step.wide = kImageWide;
    step.jump = kImageJump;
    image_posterior(out->likelihood.data(), out->posterior.data(), out->broad.data(), part.y1 - part.y0,
                    part.x1 - part.x0, n, step, peaks, out->place.data(), out->mass.data(), peaks > 1, threads_, watch);
}

std::vector<float> ImageSolver::signal_of(const ImagePart& part) const {
    std::vector<float> out;
    out.reserve(part.pixels());
    for (int64_t y = part.y0; y < part.y1; ++y)
        for (int64_t x = part.x0; x < part.x1; ++x)
            out.push_back(static_cast<float>(light_.signal[y * photons_.width + x]));
    return out;
}

ImageCandidates ImageSolver::candidates(const ImageVolumes& of, const ImagePart& part, const float* signal) const {
    static const ImageOffsets offsets;
    ImageCandidates task{};
    task.posterior = of.posterior.data();
    task.broad = of.broad.data();
    task.likelihood = of.likelihood.data();
    task.height = part.y1 - part.y0;
    task.width = part.x1 - part.x0;
    task.cells = setting_->cells;
    task.peaks = kImagePeaks;
    task.place = of.place.data();
    task.mass = of.mass.data();
    task.signal = signal;
    task.down = offsets.down;
    task.right = offsets.right;
    task.offsets = kImageOffsets;
    task.hidden = kImageHidden;
    return task;
}

void ImageSolver::candidate_features(const ImageVolumes& of, const std::vector<int64_t>& pixel, float* out,
                                     const Watch& watch) const {
    const std::vector<float> signal = signal_of(whole());
    ImageCandidates task = candidates(of, whole(), signal.data());
    task.pixel = pixel.data();
    task.count = static_cast<int64_t>(pixel.size());
    task.features = out;
    image_candidates(task, threads_, watch);
}

void ImageSolver::choose(const ImageNetworks* networks, const Watch& watch) {
    const int n = setting_->cells;
    for (std::vector<float>* each :
         {&chosen_.delay, &chosen_.confidence, &chosen_.mass, &chosen_.spread, &chosen_.broad})
        each->resize(pixels());
    ImageVolumes of;
    for (const Cut& cut : cuts()) {
        const ImagePart &part = cut.part, &kept = cut.kept;
        volumes(part, kImagePeaks, &of, watch);
        std::vector<int64_t> here, open;  // pixels of the part that are kept, and of these those that a network decides
        for (int64_t y = kept.y0; y < kept.y1; ++y)
            for (int64_t x = kept.x0; x < kept.x1; ++x) {
                const int64_t q = (y - part.y0) * (part.x1 - part.x0) + x - part.x0;
                here.push_back(q);
                if (networks && of.mass[q * kImagePeaks] < kImageSettled) open.push_back(q);
            }
        std::vector<int32_t> best(open.size());
        std::vector<float> chance(open.size());
        if (!open.empty()) {
            const std::vector<float> signal = signal_of(part);
            ImageCandidates task = candidates(of, part, signal.data());
            task.pixel = open.data();
            task.count = static_cast<int64_t>(open.size());
            task.weights = networks->weights.data();
            task.chosen = best.data();
            task.confidence = chance.data();
            image_candidates(task, threads_, watch);
        }
        size_t next = 0;
        for (const int64_t q : here) {
            const int64_t across = part.x1 - part.x0;
            const int64_t p = (part.y0 + q / across) * photons_.width + part.x0 + q % across;
            float place = of.place[q * kImagePeaks], confidence = of.mass[q * kImagePeaks];
            if (next < open.size() && open[next] == q) {
                place = of.place[q * kImagePeaks + best[next]];
                confidence = chance[next++];
            }
            const int cell = std::min(static_cast<int>(place), n - 1);
            const float* const posterior = of.posterior.data() + q * n;
            float total = 0.0f, first = 0.0f, second = 0.0f;
            for (int d = -3; d <= 3; ++d) {
                const float mass = posterior[(cell + d + n) % n] + 1e-9f, step = static_cast<float>(d);
                total += mass;
                first += mass * step;
                second += mass * step * step;
            }
            const float mean = first / total;
            chosen_.delay[p] = wrapped(static_cast<float>(cell) + 0.5f + mean, static_cast<float>(n));
            chosen_.confidence[p] = confidence;
            chosen_.mass[p] = total;
            chosen_.spread[p] = std::sqrt(std::max(second / total - mean * mean, 0.01f));
            chosen_.broad[p] = of.broad[q * n + cell];
        }
    }
}

void ImageSolver::refine(const ImageSetting& finer, const Watch& watch) {
    photometry(watch);
    const double n = setting_->cells, scale = finer.cells / n;
    std::vector<float> delay(pixels());
    in_blocks([&](int64_t first, int64_t last) {
        const std::vector<float> plane = planes(first, last, watch);
        for (int64_t p = first * photons_.width; p < last * photons_.width; ++p) {
            const float* const of = plane.data() + (p - first * photons_.width) * kImageWindows * kImageMoments;
            const double at =
                static_cast<double>(chosen_.delay[p]) + static_cast<double>(agreeing(p, of).offset) * setting_->sigma;
            delay[p] = static_cast<float>(wrapped(wrapped(at, n) * scale, static_cast<double>(finer.cells)));
        }
    });
    chosen_.delay = delay;
    setting_ = &finer;
}

void ImageSolver::look(const Watch& watch) {
    light_at(chosen_.delay.data(), watch);
    photometry(watch);
}

// Three steps, so that many photons of one pixel find their own centroid.
void ImageSolver::photometry(const Watch& watch) {
    const std::vector<float> columns = centroids(chosen_.delay.data(), 3, watch);
    for (std::vector<float>* each : {&seen_.number, &seen_.offset, &seen_.exposure}) each->resize(pixels());
    for (int64_t p = 0; p < pixels(); ++p) {
        const float* const of = columns.data() + p * kImageColumns;
        seen_.number[p] = of[0];
        seen_.offset[p] = of[1];
        seen_.exposure[p] = light_.missing[p] ? 0.0f : static_cast<float>(static_cast<double>(of[2]) * efficiency(p));
    }
}

template <class Each>
void ImageSolver::in_blocks(const Each& each) const {
    const int64_t step = std::max<int64_t>(1, block_pixels_ / photons_.width);
    for (int64_t y = 0; y < photons_.height; y += step) each(y, std::min(photons_.height, y + step));
}

// (rows, width, windows, moments) of the rows [first, last).
std::vector<float> ImageSolver::planes(int64_t first, int64_t last, const Watch& watch) const {
    const int64_t height = photons_.height, width = photons_.width, pitch = width + 2 * kMargin + kImageLanes,
                  size = (last - first + 2 * kMargin) * pitch;
    std::vector<float> images(4 * size, 0.0f), out((last - first) * width * kImageWindows * kImageMoments);
    const std::vector<float>* const from[4] = {&seen_.number, &seen_.offset, &chosen_.delay, &seen_.exposure};
    for (int64_t y = std::max<int64_t>(0, first - kMargin); y < std::min(height, last + kMargin); ++y)
        for (int k = 0; k < 4; ++k)
            std::copy_n(from[k]->data() + y * width, width,
                        images.data() + k * size + (y - first + kMargin) * pitch + kMargin);
    ImagePlanes task{};
    task.number = images.data();
    task.offset = task.number + size;
    task.delay = task.offset + size;
    task.exposure = task.delay + size;
    task.width = width;
    task.margin = kMargin;
    task.cells = static_cast<float>(setting_->cells);
    task.sigma = static_cast<float>(setting_->sigma);
    task.radii = kImageRadii;
    task.windows = kImageWindows;
    task.out = out.data();
    image_planes(task, 0, last - first, threads_, watch);
    return out;
}

// The largest window that agrees with all smaller ones: intersection of confidence intervals (Katkovnik, IEEE Trans. Signal
// Process. 47, 2567, 1999). `plane`: (windows, moments) of pixel p.
ImageSolver::Window ImageSolver::agreeing(int64_t p, const float* plane) const {
    const float number = seen_.number[p], sigma = static_cast<float>(setting_->sigma);
    const bool own = number > kOwn;
    Window at{seen_.offset[p] / sigma, own ? 1.0f / std::sqrt(number) : 9.0f,
              number / std::max(seen_.exposure[p], 1e-3f), number};
    Window best = at, light = at;
    float low = -HUGE_VALF, high = HUGE_VALF, dim = -HUGE_VALF, bright = HUGE_VALF;
    bool agrees = true;
    for (int k = 0; k <= kImageWindows; ++k) {
        if (k > 0) {
            const float* const m = plane + (k - 1) * kImageMoments;
            at = {m[0], std::max(m[1], 0.03f), m[5], m[4]};
        }
        low = std::max(low, at.offset - kKappa * at.error);
        high = std::min(high, at.offset + kKappa * at.error);
        agrees = agrees && low <= high;
        if (k == 1 ? agrees || !own : agrees) best = at;
        if (!own) continue;  // signals tell edges too, where a pixel has enough of it
        const float error = at.signal / std::sqrt(at.light);
        dim = std::max(dim, at.signal - kKappa * error);
        bright = std::min(bright, at.signal + kKappa * error);
        if (agrees && dim <= bright) light = at;
    }
    if (own) {
        best.signal = light.signal;
        best.light = light.light;
    }
    return best;
}

float ImageSolver::background_near(int64_t p) const {
    return std::max(static_cast<float>(light_.background[p]), static_cast<float>(kLeastLight)) *
           (5.0f * static_cast<float>(setting_->sigma) / static_cast<float>(setting_->cells));
}

ImagePlaneFeatures ImageSolver::plane_features(int64_t first, int64_t last, const Watch& watch) const {
    const int64_t width = photons_.width, size = (last - first) * width;
    const float sigma = static_cast<float>(setting_->sigma);
    const std::vector<float> plane = planes(first, last, watch);
    ImagePlaneFeatures out;
    out.features.resize(kImagePlaneFeatures * size);
    out.delays.resize(kImageDelays * size);
    out.log_signals.resize(kImageSignals * size);
    // of a Gaussian 0: how much finer than its width a pulse tells the delay
    const float finer = static_cast<float>(2.0 * std::log(setting_->near / (2.0 * kGaussianNear * setting_->sigma)));
    for (int64_t q = 0; q < size; ++q) {
        const int64_t p = first * width + q;
        const float* const of = plane.data() + q * kImageWindows * kImageMoments;
        float delay[kImageDelays] = {}, log_signal[kImageSignals];
        log_signal[0] = std::log(static_cast<float>(light_.signal[p]));
        for (int w = 0; w < kImageWindows; ++w) {
            delay[w + 1] = clipped(of[w * kImageMoments], -4.0f, 4.0f);
            log_signal[w + 1] = std::log(std::max(of[w * kImageMoments + 5], static_cast<float>(kLeastLight)));
        }
        const float number = seen_.number[p];
        log_signal[kImageSignals - 1] =
            std::log(std::max(number / std::max(seen_.exposure[p], 0.05f), static_cast<float>(kLeastLight)));
        float* to = out.features.data() + q;
        const auto add = [&](float value) {
            *to = value;
            to += size;
        };
        for (int w = 0; w < kImageWindows; ++w) add(delay[w + 1]);
        for (int w = 0; w < kImageWindows; ++w) add(0.5f * std::log(clipped(of[w * kImageMoments + 1], 0.01f, 10.0f)));
        for (int w = 0; w < kImageWindows; ++w) add(std::log(clipped(of[w * kImageMoments + 2], 0.02f, 20.0f)));
        for (int w = 0; w < kImageWindows; ++w) add(of[w * kImageMoments + 3]);
        for (int w = 0; w <= kImageWindows; ++w) add(log_signal[w] - log_signal[2]);
        add(log_signal[0]);
        add(std::log(chosen_.spread[p] / sigma));
        add(0.5f * std::log(chosen_.mass[p] + 1e-3f));
        add(0.5f * std::log(std::max(chosen_.confidence[p], 0.0f) + 1e-3f));
        add(std::log(background_near(p)));
        // photons beyond those that the smallest but one of the windows leads to expect while the pixel is armed
        add(clipped(number - std::max(of[kImageMoments + 5], static_cast<float>(kLeastLight)) * seen_.exposure[p],
                    -10.0f, 10.0f));
        add(0.5f * std::log(clipped(1.0f - chosen_.broad[p], 1e-3f, 1.0f)));
        add(finer);
        for (int k = 0; k < kImageDelays; ++k) out.delays[k * size + q] = delay[k];
        for (int k = 0; k < kImageSignals; ++k) out.log_signals[k * size + q] = log_signal[k];
    }
    return out;
}

void ImageSolver::estimate(const ImageNetworks* networks, double* maps, uint8_t* flags, const Watch& watch) {
    const int64_t height = photons_.height, width = photons_.width, all = pixels();
    const double n = setting_->cells, sigma = setting_->sigma,
                 cycles = static_cast<double>(setting_->recording->cycles);
    const bool empty = photons_.first[all] == 0;
    const auto map = [&](ImageMap which) { return maps + which * all; };
    // of a Laplace distribution; `half` in cells too
    const auto put = [&](int64_t p, double offset, double scale, double half, double doubt, double signal,
                         double signal_scale) {
        const bool fill = doubt > kFilledAbove || light_.missing[p];
        flags[p] = static_cast<uint8_t>(fill ? kFilled : 0);
        if (empty) flags[p] |= kEmpty;
        half = fill ? kNone : half / n;
        map(kImageDelay)[p] =
            empty ? kNone : wrapped((static_cast<double>(chosen_.delay[p]) + offset * sigma) / n, 1.0);
        map(kImageHalfWidth)[p] = half;
        map(kImageDeviation)[p] = std::isfinite(half) ? std::sqrt(2.0) * scale / n : kNone;
        map(kImageOutlier)[p] = light_.missing[p] ? 1.0 : doubt;
        map(kImageSignal)[p] = empty ? 0.0 : signal / cycles;
        map(kImageSignalError)[p] = std::sqrt(2.0) * signal_scale * signal / cycles;
        map(kImageBackground)[p] = empty ? 0.0 : light_.background[p] / cycles;
        map(kImageNumber)[p] = static_cast<double>(seen_.number[p]);
    };
    in_blocks([&](int64_t first, int64_t last) {
        if (!networks) {
            const std::vector<float> plane = planes(first, last, watch);
            for (int64_t p = first * width; p < last * width; ++p) {
                const Window at = agreeing(p, plane.data() + (p - first * width) * kImageWindows * kImageMoments);
                const double doubt = clipped(1.0 - static_cast<double>(chosen_.broad[p]), 0.0, 1.0);
                // the window's error knows nothing of what is rough within it; half the posterior's spread does
                const double scale = kScale * std::hypot(static_cast<double>(at.error) * sigma,
                                                         0.5 * static_cast<double>(chosen_.spread[p]));
                // a window says nothing of how signal varies within it: its signal agrees with the pixel's own
                const double own = static_cast<double>(seen_.number[p]);
                put(p, static_cast<double>(at.offset), scale, laplace_half(scale, doubt), doubt,
                    std::max(static_cast<double>(at.signal), kLeastLight),
                    own > static_cast<double>(kOwn) ? std::sqrt(0.5 / own) : kNone);
            }
            return;
        }
        const int64_t top = std::max<int64_t>(0, first - kReach), bottom = std::min(height, last + kReach),
                      size = (bottom - top) * width;
        const ImagePlaneFeatures f = plane_features(top, bottom, watch);
        const std::vector<float> outputs = image_weigh(
            f.features.data(), bottom - top, width, networks->weights.data() + ImageNetworks::kChoose, threads_, watch);
        for (int64_t p = first * width; p < last * width; ++p) {
            const int64_t q = p - top * width;
            const float* const o = outputs.data() + q;
            double weight[kImageDelays], share[kImageSignals], offset = 0.0, signal = 0.0, rest[5];
            softmax(o, kImageDelays, size, weight);
            softmax(o + kImageDelays * size, kImageSignals, size, share);
            for (int k = 0; k < 5; ++k) rest[k] = static_cast<double>(o[(kImageDelays + kImageSignals + k) * size]);
            for (int k = 0; k < kImageDelays; ++k) offset += weight[k] * static_cast<double>(f.delays[k * size + q]);
            for (int k = 0; k < kImageSignals; ++k)
                signal += share[k] * std::exp(static_cast<double>(f.log_signals[k * size + q]));
            offset += 0.3 * clipped(rest[3], -3.0, 3.0);
            const double doubt = 1.0 / (1.0 + std::exp(2.0 - rest[1]));
            double half = networks->interval_factor *
                          std::pow(1.0 + static_cast<double>(background_near(p)), networks->interval_exponent) *
                          std::exp(clipped(rest[4], -4.0, 3.0) - 0.7);
            if (half > kImageOutlierSigma || doubt > 1.0 - kImageLevel) half = kNone;
            put(p, offset, sigma * std::exp(clipped(rest[0], -4.0, 3.0) - 1.5), half * sigma, doubt, signal,
                std::exp(clipped(rest[2], -4.0, 3.0) - 1.0));
        }
    });
    std::vector<uint8_t> fill(all);
    for (int64_t p = 0; p < all; ++p) fill[p] = flags[p] & kFilled;
    if (!empty) image_fill(map(kImageDelay), fill.data(), height, width);
}

void image_fill(double* delay, const uint8_t* fill, int64_t height, int64_t width) {
    std::vector<int64_t> rest;
    std::complex<double> direction = 0.0;
    for (int64_t p = 0; p < height * width; ++p) {
        if (fill[p])
            rest.push_back(p);
        else
            direction += std::polar(1.0, kTurn * delay[p]);
    }
    if (rest.empty() || static_cast<int64_t>(rest.size()) == height * width) return;
    const double middle = std::arg(direction) / kTurn;  // unwrapped about the mean direction of all
    for (int64_t p = 0; p < height * width; ++p) delay[p] = fill[p] ? kNone : wrapped(delay[p] - middle + 0.5, 1.0);
    const auto around = [&](int64_t p) {
        Map out;
        for (int64_t y = std::max<int64_t>(0, p / width - 2); y <= std::min(height - 1, p / width + 2); ++y)
            for (int64_t x = std::max<int64_t>(0, p % width - 2); x <= std::min(width - 1, p % width + 2); ++x)
                if (std::isfinite(delay[y * width + x])) out.push_back(delay[y * width + x]);
        return out;
    };
    while (!rest.empty()) {
        std::vector<Map> known(rest.size());
        size_t enough = 0;
        for (size_t k = 0; k < rest.size(); ++k) {
            known[k] = around(rest[k]);
            enough = std::max(enough, known[k].size());
        }
        enough = std::min<size_t>(enough, 5);
        std::vector<int64_t> later;
        for (size_t k = 0; k < rest.size(); ++k) {
            if (known[k].size() < enough)
                later.push_back(rest[k]);
            else
                delay[rest[k]] = median(known[k]);
        }
        rest = later;
    }
    for (int64_t p = 0; p < height * width; ++p) delay[p] = wrapped(delay[p] + middle - 0.5, 1.0);
}

}  // namespace mars
