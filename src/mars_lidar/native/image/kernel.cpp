// Inner loops of depth from a few photons a pixel, at one vector level: image/kernel.h says what each does.
#include "image/kernel.h"

#include <cmath>
#include <cstring>

#include "lanes/lanes.h"

namespace mars {
namespace {

constexpr int kPad = 32;              // on both sides of a line of cells, so that the reach of a step needs no wrapping
constexpr float kFloor = 1e-12f;      // of a likelihood of mean 1, that of light from anywhere else
constexpr float kLeastMass = 1e-15f;  // of a cell's posterior, so that products stay normal numbers

float sum(const float* x, int count) {
    float lane[kImageLanes] = {}, total = 0.0f;
    for (int i = 0; i < count; i += kImageLanes)
        for (int l = 0; l < kImageLanes; ++l) lane[l] += x[i + l];
    for (int l = 0; l < kImageLanes; ++l) total += lane[l];
    return total;
}

// log x for normal x > 0, to 2e-5 of itself or absolutely.
inline float fast_log(float x) {
    int32_t bits;
    std::memcpy(&bits, &x, 4);
    const int32_t exponent = (bits - 0x3f2aaaab) >> 23;
    const int32_t mantissa = bits - exponent * (1 << 23);
    float m;
    std::memcpy(&m, &mantissa, 4);
    const float r = m - 1.0f;  // in [-1/3, 1/3)
    const float p =
        r * (1.0f + r * (-0.5f + r * (0.33333f +
                                      r * (-0.2502f + r * (0.2006f + r * (-0.1640f + r * (0.1410f - r * 0.1500f)))))));
    return p + 0.69314718f * static_cast<float>(exponent);
}

// e^x for x <= 0, to 1e-6 of itself; 0 below -80.
inline float fast_exp(float x) {
    const float t = (x < -80.0f ? -80.0f : x) * 1.44269504f;
    const int32_t whole = static_cast<int32_t>(t) - 1;  // t <= 0: below t
    const float f = t - static_cast<float>(whole);      // in (0, 2)
    const float h = 0.5f * f;                           // 2^f = (2^h)^2, h in (0, 1)
    const float q =
        1.0f + h * (0.693147182f +
                    h * (0.240226463f + h * (0.0555032992f + h * (0.00961959f + h * (0.00134326f + h * 0.00016025f)))));
    const int32_t bits = (whole + 127) << 23;
    float power;
    std::memcpy(&power, &bits, 4);
    return q * q * power;
}

// Takes the power of two out of a normal x > 0.
inline float take_power(float& x) {
    int32_t bits;
    std::memcpy(&bits, &x, 4);
    const int32_t power = (bits >> 23) - 127;
    bits = (bits & 0x007fffff) | 0x3f800000;
    std::memcpy(&x, &bits, 4);
    return static_cast<float>(power);
}

// Copies (cells) into padded + kPad and wraps both sides.
void wrap(const float* from, int cells, float* padded) {
    std::memcpy(padded + kPad, from, static_cast<size_t>(cells) * sizeof(float));
    for (int i = 0; i < kPad; ++i) {
        padded[kPad - 1 - i] = from[cells - 1 - i % cells];
        padded[kPad + cells + i] = from[i % cells];
    }
}

// f = transition of g / total; `padded` and `box` hold cells + 2 kPad each.
void transition(const float* g, float total, float* f, const ImageLine& k, float* padded, float* box) {
    const int n = k.cells;
    wrap(g, n, padded);
    const float* c = padded + kPad;
    const float scale = 1.0f / total, keep = (1.0f - k.wide - k.jump) * scale;
    const float a0 = keep * k.narrow[0], a1 = keep * k.narrow[1], a2 = keep * k.narrow[2], a3 = keep * k.narrow[3];
    const float b = k.wide * scale / 32.0f, u = k.jump / static_cast<float>(n);
    // sums over 2, 4, 8 and 16 cells; two of the last make 31 cells, the middle one twice
    float* const s = box + kPad;
    for (int i = -16; i < n + 30; ++i) s[i] = c[i] + c[i + 1];
    for (int i = -16; i < n + 28; ++i) s[i] = s[i] + s[i + 2];
    for (int i = -16; i < n + 24; ++i) s[i] = s[i] + s[i + 4];
    for (int i = -16; i < n + 16; ++i) s[i] = s[i] + s[i + 8];
    for (int i = 0; i < n; ++i)
        f[i] = u + a0 * c[i] + a1 * (c[i - 1] + c[i + 1]) + a2 * (c[i - 2] + c[i + 2]) + a3 * (c[i - 3] + c[i + 3]) +
               b * (s[i - 15] + s[i]);
}

float multiplied(const float* f, const float* x, int n, float* g) {
    for (int i = 0; i < n; ++i) g[i] = f[i] * x[i];
    return sum(g, n);
}

}  // namespace

void MARS_JOIN(image_likelihood_, MARS_LEVEL)(const ImagePixel& p) {
    constexpr float kFactor[kImageFactors] = {0.4f, 1.0f, 2.5f}, kShare[kImageFactors] = {0.3f, 0.45f, 0.25f};
    const ImagePulse& pulse = *p.pulse;
    const int n = p.cells, span = pulse.span, length = n + span;
    double count = 0.0, shift[kImageFactors];
    for (int64_t e = 0; e < p.photons; ++e) count += static_cast<double>(p.weight[e]);
    bool wide = p.armed != nullptr;  // whether the likelihood leaves the range of floats: then by logarithms
    for (int m = 0; m < kImageFactors; ++m) {
        float* const work = p.scratch + static_cast<int64_t>(2 * m) * length;
        float* const power = work + length;  // of two, which were taken out of `work`
        for (int i = 0; i < length; ++i) work[i] = 1.0f;
        for (int i = 0; i < length; ++i) power[i] = 0.0f;
        const float strength = p.ratio * kFactor[m];
        const double step = std::log1p(static_cast<double>(strength * pulse.top));
        double level = 0.0;  // log of a bound on `work`
        for (int64_t e = 0; e < p.photons; ++e) {
            const int cell = static_cast<int>(p.time[e]);
            const float within = p.time[e] - static_cast<float>(cell);
            const float* const q =
                pulse.density + static_cast<int64_t>(within * static_cast<float>(pulse.phases)) * span;
            float* const w = work + cell;
            for (float left = p.weight[e]; left > 0.0f;) {
                float now = std::floor(static_cast<float>(30.0 / step));
                now = now < 1.0f ? 1.0f : now;
                now = now < left ? now : left;
                if (level + step * static_cast<double>(now) > 40.0) {  // so that two of them are in range as well
                    for (int i = 0; i < length; ++i) power[i] += take_power(work[i]);
                    wide = true;
                    level = 0.7;
                }
                for (int times = static_cast<int>(now); times > 0; --times)
                    for (int k = 0; k < span; ++k) w[k] *= 1.0f + strength * q[k];
                level += step * static_cast<double>(now);
                left -= now;
            }
        }
        // work[x] is of cell x + first, modulo the period
        for (int x = 0; x < span; ++x) work[x] *= work[x + n];
        for (int x = 0; x < span; ++x) power[x] += power[x + n];
        shift[m] = std::log(static_cast<double>(kShare[m]));
        if (!p.armed) shift[m] -= count * std::log1p(static_cast<double>(strength));
    }
    double highest = -HUGE_VAL;
    for (int m = 0; m < kImageFactors; ++m) highest = shift[m] > highest ? shift[m] : highest;
    for (int i = 0; i < n; ++i) p.out[i] = 0.0f;
    const int turn = ((-pulse.first) % n + n) % n;  // of `work` is cell 0
    float largest = -HUGE_VALF;
    for (int m = 0; m < kImageFactors && wide; ++m) {  // times (1 + ratio armed)^-photons
        float* const work = p.scratch + static_cast<int64_t>(2 * m) * length;
        const float photons = static_cast<float>(count), ratio = p.ratio * kFactor[m];
        const float base = static_cast<float>(shift[m] - highest);
        const auto exponents = [&](int from, int to, int cells) {
            float* const w = work + from;
            const float* const power = work + length + from;
            for (int i = 0; i < cells; ++i) w[i] = base + fast_log(w[i]) + 0.69314718f * power[i];
            const float* const armed = p.armed + to;
            for (int i = 0; i < cells && p.armed; ++i)
                w[i] = armed[i] < p.least ? -HUGE_VALF : w[i] - photons * fast_log(1.0f + ratio * armed[i]);
            for (int i = 0; i < cells; ++i) largest = w[i] > largest ? w[i] : largest;
        };
        exponents(turn, 0, n - turn);
        exponents(0, n - turn, turn);
    }
    for (int m = 0; m < kImageFactors && (!wide || largest > -HUGE_VALF); ++m) {
        const float share = static_cast<float>(std::exp(shift[m] - highest));
        const float* const work = p.scratch + static_cast<int64_t>(2 * m) * length;
        const auto put = [&](const float* w, float* out, int cells) {
            if (wide)
                for (int i = 0; i < cells; ++i) out[i] += fast_exp(w[i] - largest);
            else
                for (int i = 0; i < cells; ++i) out[i] += w[i] * share;
        };
        put(work + turn, p.out, n - turn);
        put(work, p.out + n - turn, turn);
    }
    float top = 0.0f;  // first by the largest: the mean of very bright pixels overflows
    for (int i = 0; i < n; ++i) top = p.out[i] > top ? p.out[i] : top;
    top = top > 0.0f ? top : 1.0f;
    for (int i = 0; i < n; ++i) p.out[i] /= top;
    const float mean = sum(p.out, n) / static_cast<float>(n);
    const float scale = mean > 0.0f ? 1.0f / mean : 1.0f;
    for (int i = 0; i < n; ++i) p.out[i] = p.out[i] * scale + kFloor;
}

void MARS_JOIN(image_line_, MARS_LEVEL)(const ImageLine& k) {
    const int n = k.cells;
    float* const g = k.scratch;
    float* const f = g + n;
    float* const padded = f + n;
    float* const box = padded + n + 2 * kPad;
    float* const before = box + n + 2 * kPad;  // (count, cells) messages from the pixels before
    for (int i = 0; i < n; ++i) f[i] = 1.0f / static_cast<float>(n);
    for (int64_t j = 0; j < k.count; ++j) {
        std::memcpy(before + j * n, f, static_cast<size_t>(n) * sizeof(float));
        const float total = multiplied(f, k.in + j * k.stride, n, g);
        transition(g, total, f, k, padded, box);
    }
    for (int i = 0; i < n; ++i) f[i] = 1.0f / static_cast<float>(n);
    for (int64_t j = k.count; j-- > 0;) {
        const float* const message = before + j * n;
        const float total = multiplied(f, k.in + j * k.stride, n, g);
        float* const to = k.out + j * k.stride;
        float* const product = box;  // free until the next transition
        const float scale = 1.0f / multiplied(message, g, n, product);
        for (int i = 0; i < n; ++i) to[i] = product[i] * scale + kLeastMass;
        transition(g, total, f, k, padded, box);
    }
}

void MARS_JOIN(image_posterior_, MARS_LEVEL)(const ImagePosterior& k) {
    const int n = k.cells;
    float* const padded = k.scratch;
    float* const near = padded + n + 2 * kPad;
    for (int64_t p = 0; p < k.count; ++p) {
        float* const x = k.one + p * n;
        float* const y = k.other + p * n;
        for (int i = 0; i < n; ++i) x[i] = std::sqrt(x[i] * y[i]);
        const float scale = 1.0f / sum(x, n);
        for (int i = 0; i < n; ++i) x[i] *= scale;
        wrap(x, n, padded);
        const float* const c = padded + kPad;
        for (int i = 0; i < n; ++i) near[i] = c[i - 2] + c[i - 1] + c[i] + c[i + 1] + c[i + 2];
        for (int m = 0; m < k.peaks; ++m) {
            float lane[kImageLanes], most = -2.0f;
            for (int l = 0; l < kImageLanes; ++l) lane[l] = -2.0f;
            for (int i = 0; i < n; i += kImageLanes)
                for (int l = 0; l < kImageLanes; ++l) lane[l] = near[i + l] > lane[l] ? near[i + l] : lane[l];
            for (int l = 0; l < kImageLanes; ++l) most = lane[l] > most ? lane[l] : most;
            int t = 0;
            while (near[t] != most) ++t;
            float mass = 0.0f, moment = 0.0f;
            for (int o = -2; o <= 2; ++o) {
                mass += c[t + o];
                moment += c[t + o] * static_cast<float>(o);
            }
            const bool is = most >= 0.0f;
            k.mass[p * k.peaks + m] = is ? mass : 0.0f;
            float place = static_cast<float>(t) + 0.5f + (is ? moment / mass : 0.0f);
            place = place < 0.0f ? place + static_cast<float>(n) : place;
            k.place[p * k.peaks + m] = place >= static_cast<float>(n) ? place - static_cast<float>(n) : place;
            for (int o = -4; o <= 4; ++o) near[(t + o + n) % n] = -1.0f;
        }
        if (!k.broad) continue;
        for (int i = 0; i < n; ++i) {
            float s = c[i];
            for (int o = 1; o <= 8; ++o) s += c[i - o] + c[i + o];
            y[i] = s;
        }
    }
}

namespace {

// Outputs (outputs, 16) of a layer of a network for 16 inputs side by side (inputs, 16).
void layer(const float* x, int inputs, const float* weights, const float* bias, int outputs, bool rectify, float* to) {
    for (int o = 0; o < outputs; ++o)
        for (int l = 0; l < kImageLanes; ++l) to[o * kImageLanes + l] = bias[o];
    for (int i = 0; i < inputs; ++i)
        for (int o = 0; o < outputs; ++o) {
            const float w = weights[i * outputs + o];
            for (int l = 0; l < kImageLanes; ++l) to[o * kImageLanes + l] += w * x[i * kImageLanes + l];
        }
    if (!rectify) return;
    for (int i = 0; i < outputs * kImageLanes; ++i) to[i] = to[i] > 0.0f ? to[i] : 0.0f;
}

}  // namespace

void MARS_JOIN(image_candidates_, MARS_LEVEL)(const ImageCandidates& k) {
    const int n = k.cells, inputs = 3 * k.offsets + 3, peaks = k.peaks;
    float* const x = k.scratch;
    float* const first = x + kImageLanes * inputs;
    float* const second = first + kImageLanes * k.hidden;
    const float* const w1 = k.weights;
    const float* const b1 = w1 + inputs * k.hidden;
    const float* const w2 = b1 + k.hidden;
    const float* const b2 = w2 + k.hidden * k.hidden;
    const float* const w3 = b2 + k.hidden;
    const float* const b3 = w3 + k.hidden;
    const float* const none = b3 + 1;         // two weights and a bias
    const int at_once = kImageLanes / peaks;  // pixels
    for (int64_t begin = 0; begin < k.count; begin += at_once) {
        const int pixels = static_cast<int>(k.count - begin < at_once ? k.count - begin : at_once);
        const int lanes = pixels * peaks;
        for (int i = 0; i < inputs * kImageLanes; ++i) x[i] = 1.0f;
        for (int l = 0; l < lanes; ++l) {
            const int64_t p = k.pixel[begin + l / peaks], y = p / k.width, c = p % k.width;
            int t = static_cast<int>(k.place[p * peaks + l % peaks]);
            t = t >= n ? t - n : t;
            const int before = t == 0 ? n - 1 : t - 1, after = t == n - 1 ? 0 : t + 1;
            for (int o = 0; o < k.offsets; ++o) {
                int64_t row = y + k.down[o], column = c + k.right[o];  // mirrored at the borders
                row = row < 0 ? -row : row;
                row = row >= k.height ? 2 * k.height - 2 - row : row;
                column = column < 0 ? -column : column;
                column = column >= k.width ? 2 * k.width - 2 - column : column;
                const int64_t q = (row * k.width + column) * n;
                const float *post = k.posterior + q, *like = k.likelihood + q;
                float* const to = x + 3 * o * kImageLanes + l;
                to[0] = post[before] + post[t] + post[after] + 1e-3f;
                to[kImageLanes] = k.broad[q + t] + 1e-3f;
                to[2 * kImageLanes] = (like[before] + like[t] + like[after]) * (1.0f / 3.0f) + 1e-2f;
            }
            float most = 0.0f;
            for (int m = 0; m < peaks; ++m) most = k.mass[p * peaks + m] > most ? k.mass[p * peaks + m] : most;
            float* const to = x + 3 * k.offsets * kImageLanes + l;
            const float mass = k.mass[p * peaks + l % peaks] + 1e-4f;
            to[0] = mass;
            to[kImageLanes] = mass / (most + 1e-4f);
            to[2 * kImageLanes] = k.signal[p] + 0.05f;
        }
        for (int i = 0; i < inputs * kImageLanes; ++i) x[i] = fast_log(x[i]) * (1.0f / 3.0f);
        if (k.features) {
            for (int l = 0; l < lanes; ++l)
                for (int i = 0; i < inputs; ++i) k.features[(begin * peaks + l) * inputs + i] = x[i * kImageLanes + l];
            continue;
        }
        float value[kImageLanes];
        layer(x, inputs, w1, b1, k.hidden, true, first);
        layer(first, k.hidden, w2, b2, k.hidden, true, second);
        layer(second, k.hidden, w3, b3, 1, false, value);
        const float* const own = x + 3 * k.offsets * kImageLanes;
        for (int j = 0; j < pixels; ++j) {
            // "none of them" is one more; the prior of each is its mass
            const int l0 = j * peaks;
            float most = none[0] * 3.0f * own[l0] + none[1] * 3.0f * own[2 * kImageLanes + l0] + none[2];
            const float other = most;
            int best = 0;
            for (int m = 0; m < peaks; ++m) {
                value[l0 + m] += 3.0f * own[l0 + m];
                most = value[l0 + m] > most ? value[l0 + m] : most;
                best = value[l0 + m] > value[l0 + best] ? m : best;
            }
            float total = std::exp(other - most);
            for (int m = 0; m < peaks; ++m) total += std::exp(value[l0 + m] - most);
            k.chosen[begin + j] = best;
            k.confidence[begin + j] = std::exp(value[l0 + best] - most) / total;
        }
    }
}

// Sixteen pixels of a row side by side. Weights by distance d of a pixel's delay from the plane so far, (1 - (d / 4.5
// sigma)^2)^4, near a Gaussian of 1.5 sigma. Out, relative to the pixel's delay and in sigma: the plane's delay, its
// standard error and mean square misfit; share of the photons that it keeps, their number, photons a pixel, and pixels.
void MARS_JOIN(image_planes_, MARS_LEVEL)(const ImagePlanes& k) {
    constexpr int L = kImageLanes;
    const int64_t pitch = k.width + 2 * k.margin + L;
    const float half = 0.5f * k.cells, reach = 4.5f * k.sigma, inverse = 1.0f / (reach * reach);
    for (int64_t x0 = k.first; x0 < k.last; x0 += L) {
        const int64_t here = (k.y + k.margin) * pitch + x0 + k.margin;
        const float* const own = k.delay + here;
        float t[L] = {}, a[L] = {}, b[L] = {};
        for (int w = 0; w < k.windows; ++w) {
            const int radius = k.radii[w];
            for (int pass = w == 0 ? 0 : 1; pass < 2; ++pass) {
                float s0[L], sx[L] = {}, sy[L] = {}, sxx[L] = {}, sxy[L] = {}, syy[L] = {}, su[L] = {}, sxu[L] = {},
                             syu[L] = {}, suu[L] = {}, all[L], area[L], light[L] = {};
                for (int l = 0; l < L; ++l) s0[l] = all[l] = area[l] = 1e-9f;
                for (int dy = -radius; dy <= radius; ++dy)
                    for (int dx = -radius; dx <= radius; ++dx) {
                        const int64_t q = here + dy * pitch + dx;
                        const float *number = k.number + q, *offset = k.offset + q, *delay = k.delay + q,
                                    *exposure = k.exposure + q;
                        const float X = static_cast<float>(dx), Y = static_cast<float>(dy);
                        for (int l = 0; l < L; ++l) {
                            float f = delay[l] - own[l];
                            f = f > half ? f - k.cells : f;
                            f = f < -half ? f + k.cells : f;
                            const float m = number[l], u = f + offset[l];
                            const float z = f - (t[l] + a[l] * X + b[l] * Y);
                            float g = 1.0f - z * z * inverse;
                            g = g > 0.0f ? g : 0.0f;
                            g *= g;
                            g *= g;
                            const float v = m * g;
                            all[l] += m;
                            area[l] += g * exposure[l];
                            light[l] += v;
                            s0[l] += v;
                            sx[l] += v * X;
                            sy[l] += v * Y;
                            sxx[l] += v * (X * X);
                            sxy[l] += v * (X * Y);
                            syy[l] += v * (Y * Y);
                            su[l] += v * u;
                            sxu[l] += v * u * X;
                            syu[l] += v * u * Y;
                            suu[l] += v * u * u;
                        }
                    }
                float result[kImageMoments][L];
                for (int l = 0; l < L; ++l) {
                    const float ridge = 0.125f * s0[l] + 0.3f;  // holds slopes by a little flatness
                    const float A = s0[l], B = sx[l], C = sy[l], D = sxx[l] + ridge, E = sxy[l], F = syy[l] + ridge;
                    const float det = A * (D * F - E * E) - B * (B * F - E * C) + C * (B * E - D * C);
                    const bool solved = det > 1e-6f * A * D * F;
                    const float r = 1.0f / (solved ? det : 1.0f), flat = 1.0f / A;
                    const float i00 = solved ? (D * F - E * E) * r : flat, i01 = solved ? (C * E - B * F) * r : 0.0f,
                                i02 = solved ? (B * E - C * D) * r : 0.0f, i11 = solved ? (A * F - C * C) * r : 0.0f,
                                i12 = solved ? (B * C - A * E) * r : 0.0f, i22 = solved ? (A * D - B * B) * r : 0.0f;
                    float at = i00 * su[l] + i01 * sxu[l] + i02 * syu[l];
                    a[l] = i01 * su[l] + i11 * sxu[l] + i12 * syu[l];
                    b[l] = i02 * su[l] + i12 * sxu[l] + i22 * syu[l];
                    const float misfit = (suu[l] - at * su[l] - a[l] * sxu[l] - b[l] * syu[l]) / A;
                    const float most = 4.0f * k.sigma;
                    at = at > most ? most : at;
                    at = at < -most ? -most : at;
                    t[l] = at;
                    result[0][l] = at / k.sigma;
                    result[1][l] = std::sqrt(i00 > 0.0f ? i00 : 0.0f);
                    result[2][l] = misfit / (k.sigma * k.sigma);
                    result[3][l] = A / all[l];
                    result[4][l] = A;
                    result[5][l] = light[l] / area[l];
                    result[6][l] = area[l];
                }
                if (pass == 0) continue;
                for (int l = 0; l < L && x0 + l < k.last; ++l)
                    for (int c = 0; c < kImageMoments; ++c)
                        k.out[((x0 - k.first + l) * k.windows + w) * kImageMoments + c] = result[c][l];
            }
        }
    }
}

void MARS_JOIN(image_convolution_, MARS_LEVEL)(const ImageConvolution& k) {
    constexpr int L = kImageLanes, kAtOnce = 16;
    const int taps = k.side * k.side, margin = 1 - k.side / 2;
    for (int64_t x0 = 0; x0 < k.width; x0 += L)
        for (int o0 = 0; o0 < k.outputs; o0 += kAtOnce) {
            const int outputs = k.outputs - o0 < kAtOnce ? k.outputs - o0 : kAtOnce;
            float sum_[kAtOnce][L];
            for (int o = 0; o < kAtOnce; ++o)
                for (int l = 0; l < L; ++l) sum_[o][l] = o < outputs ? k.bias[o0 + o] : 0.0f;
            for (int i = 0; i < k.inputs; ++i)
                for (int t = 0; t < taps; ++t) {
                    const float* const from =
                        k.in + i * k.plane + (k.y + margin + t / k.side) * k.pitch + x0 + margin + t % k.side;
                    float v[L];
                    for (int l = 0; l < L; ++l) v[l] = k.rectified && !(from[l] > 0.0f) ? 0.0f : from[l];
                    const float* const w = k.weights + (i * taps + t) * k.outputs + o0;
                    if (outputs == kAtOnce) {
                        for (int o = 0; o < kAtOnce; ++o)
                            for (int l = 0; l < L; ++l) sum_[o][l] += w[o] * v[l];
                    } else {
                        for (int o = 0; o < outputs; ++o)
                            for (int l = 0; l < L; ++l) sum_[o][l] += w[o] * v[l];
                    }
                }
            for (int o = 0; o < outputs; ++o)
                for (int l = 0; l < L && x0 + l < k.width; ++l) k.out[(o0 + o) * k.out_plane + x0 + l] = sum_[o][l];
        }
}

}  // namespace mars
