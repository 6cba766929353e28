// Depth, signal and background of a pixel from the photons of its neighbours too, on a plane: docs/reconstruction.md, section 10.
// For light so dim that a pixel is armed nearly always; the photons of a window are few, and are taken one by one.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "reconstruct/histogram_record.h"
#include "reconstruct/solve.h"

namespace mars {

// Share of the photons that are signal, the delay at the pixel, and how it grows to the right and down, periods a pixel.
struct Plane {
    double share, delay, right, down;
};

// An image of histograms as lists of bins, one for each registration.
struct PhotonImage {
    int64_t height, width;
    const int64_t* first;    // (pixels + 1) of the bins of each pixel
    const int32_t* bins;     // (registrations)
    const double* exposure;  // (pixels) passes in which the pixel was armed, mean over the period
};

// S, B, their errors and that of the delay, twice the gain in log likelihood over background alone, and the logarithm of the
// likelihood of the pixel's own photons by what the others say.
constexpr int kSurfaceColumns = 7;

class SurfaceFit {
 public:
    SurfaceFit(const HistogramRecord& recording, const PhotonImage& image, int radius)
        : r_(recording), image_(image), radius_(radius) {}

    // Of pixel `at`, from the planes (pixels) of smaller windows; `tilted`: right and down are not held at 0.
    Plane operator()(int64_t at, const Plane* before, bool tilted, double* out) {
        gather(at);
        const Plane start = best_start(at, before, tilted, true), hole = best_start(at, before, tilted, false);
        const Plane found = climb(start, tilted, false);
        const Plane without = climb(hole, tilted, true);
        std::fill(out, out + kSurfaceColumns, NAN);
        out[6] = 0.0;
        for (int64_t k = 0; k < own_; ++k) out[6] += std::log(density(without, photons_[k]).mixture);
        out[0] = out[1] = out[5] = 0.0;
        if (photons_.empty()) return found;
        const double all = static_cast<double>(photons_.size());
        out[0] = found.share * all / exposure_;
        out[1] = (1.0 - found.share) * all / exposure_;
        out[5] = std::max(2.0 * (value(found, 0) + all * std::log(static_cast<double>(r_.bins))), 0.0);
        errors(found, tilted, out);
        return found;
    }

 private:
    struct Photon {
        double low;  // edge of its bin, in periods
        double right, down;
    };

    struct Density {
        double mixture, pulse, slope;  // chance of its bin, that of the pulse there, and its derivative by the delay
    };

    static constexpr int kSteps = 40;
    static constexpr double kLeastShare = 1e-3;

    // The photons of the window, those of the pixel itself first.
    void gather(int64_t at) {
        photons_.clear();
        exposure_ = 0.0;
        const int64_t y = at / image_.width, x = at % image_.width;
        const double n = static_cast<double>(r_.bins);
        auto take = [&](int64_t v, int64_t u) {
            const int64_t pixel = v * image_.width + u;
            exposure_ += image_.exposure[pixel];
            for (int64_t k = image_.first[pixel]; k < image_.first[pixel + 1]; ++k)
                photons_.push_back({image_.bins[k] / n, static_cast<double>(u - x), static_cast<double>(v - y)});
        };
        take(y, x);
        own_ = static_cast<int64_t>(photons_.size());
        for (int64_t v = std::max<int64_t>(y - radius_, 0); v <= std::min(y + radius_, image_.height - 1); ++v)
            for (int64_t u = std::max<int64_t>(x - radius_, 0); u <= std::min(x + radius_, image_.width - 1); ++u)
                if (u != x || v != y) take(v, u);
    }

    Density density(const Plane& plane, const Photon& photon) const {
        const double step = 1.0 / static_cast<double>(r_.bins);
        const double u = photon.low - plane.delay - plane.right * photon.right - plane.down * photon.down;
        double left, right;
        const double before = r_.pulse(u, &left), after = r_.pulse(u + step, &right);
        const double s = std::max(after - before, 0.0);
        return {plane.share * s + (1.0 - plane.share) * step, s, left - right};
    }

    double value(const Plane& plane, int64_t from) const {
        double sum = 0.0;
        for (size_t k = static_cast<size_t>(from); k < photons_.size(); ++k)
            sum += std::log(density(plane, photons_[k]).mixture);
        return sum;
    }

    // Of the plane that a smaller window had here, and those that it had around, the likeliest of this window.
    Plane best_start(int64_t at, const Plane* before, bool tilted, bool own) const {
        const int64_t y = at / image_.width, x = at % image_.width;
        const int64_t from = own ? 0 : own_;
        Plane best = before[at];
        double top = value(best, from);
        if (!tilted) return best;
        const int64_t far[2] = {radius_, (radius_ + 1) / 2};
        for (const int64_t q : far)
            for (int side = 0; side < 4; ++side) {
                const int64_t dx = side == 0 ? q : side == 1 ? -q : 0, dy = side == 2 ? q : side == 3 ? -q : 0;
                if (x + dx < 0 || x + dx >= image_.width || y + dy < 0 || y + dy >= image_.height) continue;
                Plane next = before[(y + dy) * image_.width + x + dx];
                next.delay -= next.right * static_cast<double>(dx) + next.down * static_cast<double>(dy);
                const double here = value(next, from);
                if (here > top) {
                    top = here;
                    best = next;
                }
            }
        return best;
    }

    // Share by expectation and maximisation, plane by Fisher scoring, halved where the likelihood would fall. `hole`: without
    // the pixel's own photons.
    Plane climb(Plane plane, bool tilted, bool hole) const {
        const size_t from = hole ? static_cast<size_t>(own_) : 0;
        if (photons_.size() <= from) return plane;
        const double all = static_cast<double>(photons_.size() - from), sharp = 1.0 / (r_.width * r_.width);
        double now = value(plane, static_cast<int64_t>(from));
        for (int step = 0; step < kSteps; ++step) {
            double share = 0.0, gradient[3] = {}, information[3][3] = {}, move[3] = {};
            for (size_t k = from; k < photons_.size(); ++k) {
                const Photon& photon = photons_[k];
                const Density d = density(plane, photon);
                const double signal = plane.share * d.pulse / d.mixture;
                const double by[3] = {1.0, photon.right, photon.down};
                share += signal;
                for (int a = 0; a < 3; ++a) {
                    gradient[a] += plane.share * d.slope / d.mixture * by[a];
                    for (int b = 0; b <= a; ++b) information[a][b] += signal * sharp * by[a] * by[b];
                }
            }
            for (int a = 0; a < 3; ++a) {
                for (int b = a + 1; b < 3; ++b) information[a][b] = information[b][a];
            }
            for (int a = 0; a < 3; ++a) information[a][a] = 1.001 * information[a][a] + 1e-3 * sharp;
            const bool free[3] = {true, tilted, tilted};
            if (!solve<3>(information, gradient, free, move)) return plane;
            share = std::clamp(share / all, kLeastShare, 1.0 - kLeastShare);
            double part = std::min(1.0, 2.0 * r_.width / std::max(std::fabs(move[0]), 1e-300)), gain = 0.0;
            Plane next = plane;
            for (int trial = 0; trial < 6; ++trial, part *= 0.5) {
                next.share = share;
                next.delay = plane.delay + part * move[0];
                next.right = plane.right + part * move[1];
                next.down = plane.down + part * move[2];
                gain = value(next, static_cast<int64_t>(from)) - now;
                if (gain >= 0.0) break;
            }
            if (!(gain > 1e-4)) return gain > 0.0 ? next : plane;
            plane = next;
            now += gain;
        }
        return plane;
    }

    // From the information of a Poisson process as its photons have it, the sum of (dl / l)^2.
    void errors(const Plane& plane, bool tilted, double* out) const {
        const double signal = out[0], rate = signal + out[1], step = 1.0 / static_cast<double>(r_.bins);
        double information[5][5] = {}, spread[5][5];
        for (const Photon& photon : photons_) {
            const Density d = density(plane, photon);
            const double l = rate * d.mixture, by_delay = signal * d.slope / l;
            const double by[5] = {d.pulse / l, step / l, by_delay, by_delay * photon.right, by_delay * photon.down};
            for (int a = 0; a < 5; ++a)
                for (int b = 0; b < 5; ++b) information[a][b] += by[a] * by[b];
        }
        const bool free[5] = {true, true, true, tilted, tilted};
        if (!inverse<5>(information, free, spread)) return;
        for (int a = 0; a < 3; ++a) out[2 + a] = std::sqrt(spread[a][a]);
    }

    const HistogramRecord& r_;
    const PhotonImage& image_;
    int64_t radius_, own_ = 0;
    double exposure_ = 0.0;
    std::vector<Photon> photons_;
};

}  // namespace mars
