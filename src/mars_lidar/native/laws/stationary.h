// The stationary state of a pixel at the start of a period.
//
// A warmed-up pixel is blind at t = 0 for another rho if it registered at rho - t_d, which has the density r of
// registrations, periodic in the laser period: P(still blind for > x) = integral of r over (x - t_d, 0). The rate
// solves r(t) = lambda(t) (1 - integral of r over (t - t_d, t)). On a grid this is the cyclic feedback equation
// h_j = p_j (1 - K N - W_j) + q_j I_j with N = sum h, W the registrations of the last (t_d mod t_r) and I those
// that re-arm inside the bin, solved by Gauss-Seidel sweeps round the circle; the K whole periods of the dead
// time follow by h = w / (1 + K sum w).
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace mars {

class StationaryState {
 public:
    // `photons`: expected photons in each of n equal parts of the period. `dead_time` in periods.
    StationaryState(const std::vector<double>& photons, double dead_time)
        : dead_time_(dead_time), whole_(static_cast<int64_t>(dead_time)) {
        solve(photons);
    }

    // From registrations per period and bin that are known.
    StationaryState(double dead_time, const std::vector<double>& registrations)
        : dead_time_(dead_time),
          whole_(static_cast<int64_t>(dead_time)),
          below_(registrations.size() + 1, 0.0),
          converged_(true) {
        for (size_t j = 0; j < registrations.size(); ++j) below_[j + 1] = below_[j] + std::max(0.0, registrations[j]);
    }

    // Time to re-arming at t = 0 for a uniform number u: 0 if the pixel is armed.
    double residual(double u) const {
        const int64_t n = static_cast<int64_t>(below_.size()) - 1;
        const double total = below_[n];
        if (!(total > 0.0) || dead_time_ == 0.0) return 0.0;
        // Registrations in (-y, 0] are R(y) = total - below(-y mod 1) plus whole periods; find R(y) = u.
        const double periods = std::floor(u / total);
        const double target = total - (u - periods * total);
        int64_t low = 0, high = n;  // below[low] <= target < below[high]
        while (high - low > 1) {
            const int64_t middle = (low + high) / 2;
            (below_[middle] <= target ? low : high) = middle;
        }
        const double step = below_[high] - below_[low];
        const double phase = (low + (step > 0.0 ? (target - below_[low]) / step : 0.0)) / static_cast<double>(n);
        const double rho = dead_time_ - (periods + 1.0 - phase);
        return rho > 0.0 ? rho : 0.0;
    }

    // Throws where the sweeps did not converge, or where they end elsewhere from another beginning.
    void check(uint32_t pixel_index) const {
        const std::string name = "the stationary state of pixel " + std::to_string(pixel_index);
        if (!converged_) throw std::runtime_error(name + " did not converge; use start='armed'");
        if (!unique_)
            throw std::invalid_argument(name +
                                        " depends on when the detector was switched on: it locks to one of several "
                                        "places of the pulse and practically never leaves it; use start='armed'");
    }

    // 1 - e^-l without libm: a series for small l, else repeated squaring of e^-(l/2^k).
    static double one_minus_exp(double l) {
        if (l > 40.0) return 1.0;
        int halvings = 0;
        while (l > 0.125) {
            l *= 0.5;
            ++halvings;
        }
        double p = 1.0;
        for (int n = 12; n >= 2; --n) p = 1.0 - p * l / n;
        p *= l;
        for (; halvings > 0; --halvings) p = p * (2.0 - p);
        return p;
    }

 private:
    // One sweep round the circle: h is replaced by what follows from it.
    void sweep(std::vector<double>& h) const {
        const int64_t n = static_cast<int64_t>(h.size());
        auto at = [&](int64_t j) -> double { return h[j < 0 ? j + n : j]; };
        double window = spill_ * at(-delay_ - 1);
        for (int64_t i = 1; i <= delay_; ++i) window += at(-i);
        for (int64_t j = 0; j < n; ++j) {
            const double late = spill_ * at(j - delay_ - 1);
            double in;
            if (delay_ == 0) {  // a registration re-arms inside its own bin
                h[j] = (p_[j] * (1.0 - window) + q_[j] * late) / (1.0 - q_[j] * (1.0 - spill_));
                in = (1.0 - spill_) * h[j] + late;
            } else {
                in = (1.0 - spill_) * at(j - delay_) + late;
                h[j] = p_[j] * (1.0 - window) + q_[j] * in;
            }
            window += h[j] - in;
        }
    }

    // Sweeps to the fixed point, with Anderson's acceleration: where the background is high a few slow modes remain
    // (bright pixels fire almost periodically) that plain sweeps would take thousands of turns to forget.
    void solve(const std::vector<double>& photons) {
        const int64_t n = static_cast<int64_t>(photons.size());
        p_.resize(n);
        q_.resize(n);
        double all = 0.0;
        for (int64_t j = 0; j < n; ++j) {
            const bool same = j > 0 && photons[j] == photons[j - 1];
            p_[j] = same ? p_[j - 1] : one_minus_exp(photons[j]);
            q_[j] = same ? q_[j - 1] : (photons[j] > 1e-8 ? 1.0 - p_[j] / photons[j] : 0.5 * photons[j]);
            all += photons[j];
        }
        const double shift = (dead_time_ - static_cast<double>(whole_)) * static_cast<double>(n);
        delay_ = static_cast<int64_t>(shift);
        spill_ = shift - static_cast<double>(delay_);

        std::vector<double> x(n);
        const double armed = 1.0 / (1.0 + all * (dead_time_ - static_cast<double>(whole_)));
        for (int64_t j = 0; j < n; ++j) x[j] = photons[j] * armed;  // exact for a constant rate
        double sum = settle(x);
        // A dead time and a period without a photon make all histories equal. Where that is less likely than 1e-4, a
        // residual of 1e-8 says little: the sweeps begin once more, with more registrations late in the period.
        if (converged_ && all * static_cast<double>(whole_ + 1) > 9.2) {
            std::vector<double> y(n);
            for (int64_t j = 0; j < n; ++j)
                y[j] = 2.0 * photons[j] * armed * static_cast<double>(j) / static_cast<double>(n);
            const double other = settle(y);
            double apart = 0.0;
            for (int64_t j = 0; j < n; ++j) apart += std::fabs(x[j] / sum - y[j] / other);
            unique_ = !converged_ || apart < 2e-3;
            converged_ = true;
        }
        const double scale = 1.0 / (1.0 + static_cast<double>(whole_) * sum);
        below_.assign(n + 1, 0.0);
        for (int64_t j = 0; j < n; ++j) below_[j + 1] = below_[j] + x[j] * scale;
    }

    // From a first guess of the registrations to the fixed point; returns their sum.
    double settle(std::vector<double>& x) {
        constexpr int kPlainTurns = 16, kTurns = 80;
        const int64_t n = static_cast<int64_t>(x.size());
        std::vector<double> next, residual(n);
        std::vector<std::vector<double>> steps, changes;  // of x and of the residual, latest last
        converged_ = false;
        for (int turn = 0; turn < kTurns && !converged_; ++turn) {
            next = x;
            sweep(next);
            double error = 0.0, sum = 0.0;
            std::vector<double> before;
            if (turn > kPlainTurns) before = residual;
            for (int64_t j = 0; j < n; ++j) {
                residual[j] = next[j] - x[j];
                error += std::fabs(residual[j]);
                sum += std::fabs(next[j]);
            }
            converged_ = error <= 1e-8 * sum;
            if (turn < kPlainTurns) {  // most pixels need no more
                x.swap(next);
                continue;
            }
            if (turn > kPlainTurns) {
                for (int64_t j = 0; j < n; ++j) before[j] = residual[j] - before[j];
                changes.push_back(std::move(before));
            }
            mix(steps, changes, residual, x, next);
        }
        if (!converged_) solve_by_residuals(x);
        double sum = 0.0;
        for (double& h : x) sum += h = h > 0.0 ? h : 0.0;
        return sum;
    }

    // For pixels so bright and so nearly periodic that dozens of slow modes remain: the fixed point x = G x + b of a sweep
    // by generalised minimal residuals (Saad and Schultz, SIAM J. Sci. Stat. Comput. 7, 856 (1986)), restarted.
    void solve_by_residuals(std::vector<double>& x) {
        constexpr int kBasis = 60, kRestarts = 40;
        const size_t n = x.size();
        using Vector = std::vector<double>;
        auto dot = [n](const Vector& a, const Vector& b) {
            double sum = 0.0;
            for (size_t j = 0; j < n; ++j) sum += a[j] * b[j];
            return sum;
        };
        Vector swept_zero(n, 0.0);
        sweep(swept_zero);  // b
        for (int restart = 0; restart < kRestarts; ++restart) {
            Vector next = x;
            sweep(next);
            double error = 0.0, sum = 0.0;
            for (size_t j = 0; j < n; ++j) {
                error += std::fabs(next[j] - x[j]);
                sum += std::fabs(next[j]);
                next[j] -= x[j];
            }
            converged_ = error <= 1e-8 * sum;
            const double size = std::sqrt(dot(next, next));
            if (converged_ || !(size > 0.0)) return;
            std::vector<Vector> basis{std::move(next)};
            for (double& value : basis[0]) value /= size;
            // Hessenberg matrix, made triangular by rotations as it grows
            double h[kBasis + 1][kBasis], cosine[kBasis], sine[kBasis], g[kBasis + 1] = {size};
            int m = 0;
            for (; m < kBasis && std::fabs(g[m]) > 1e-10 * size; ++m) {
                Vector image = basis[static_cast<size_t>(m)];
                sweep(image);
                for (size_t j = 0; j < n; ++j) image[j] = basis[static_cast<size_t>(m)][j] - (image[j] - swept_zero[j]);
                for (int i = 0; i <= m; ++i) {
                    const Vector& each = basis[static_cast<size_t>(i)];
                    h[i][m] = dot(image, each);
                    for (size_t j = 0; j < n; ++j) image[j] -= h[i][m] * each[j];
                }
                h[m + 1][m] = std::sqrt(dot(image, image));
                for (double& value : image) value /= h[m + 1][m] > 0.0 ? h[m + 1][m] : 1.0;
                basis.push_back(std::move(image));
                for (int i = 0; i < m; ++i) {
                    const double above = h[i][m], below = h[i + 1][m];
                    h[i][m] = cosine[i] * above + sine[i] * below;
                    h[i + 1][m] = cosine[i] * below - sine[i] * above;
                }
                const double length = std::sqrt(h[m][m] * h[m][m] + h[m + 1][m] * h[m + 1][m]);
                if (!(length > 0.0)) break;
                cosine[m] = h[m][m] / length;
                sine[m] = h[m + 1][m] / length;
                h[m][m] = length;
                g[m + 1] = -sine[m] * g[m];
                g[m] *= cosine[m];
            }
            for (int i = m - 1; i >= 0; --i) {
                for (int k = i + 1; k < m; ++k) g[i] -= h[i][k] * g[k];
                g[i] /= h[i][i];
            }
            for (int i = 0; i < m; ++i)
                for (size_t j = 0; j < n; ++j) x[j] += g[i] * basis[static_cast<size_t>(i)][j];
        }
    }

    // x <- next - sum gamma (step + change), gamma the least squares fit of the residual by its changes.
    static void mix(std::vector<std::vector<double>>& steps, std::vector<std::vector<double>>& changes,
                    const std::vector<double>& residual, std::vector<double>& x, const std::vector<double>& next) {
        constexpr size_t kDepth = 4;
        const size_t n = x.size();
        if (changes.size() > kDepth) {
            changes.erase(changes.begin());
            steps.erase(steps.begin());
        }
        const size_t m = changes.size();
        double a[kDepth][kDepth + 1];
        for (size_t i = 0; i < m; ++i) {
            for (size_t k = 0; k <= m; ++k) {
                const std::vector<double>& other = k < m ? changes[k] : residual;
                a[i][k] = 0.0;
                for (size_t j = 0; j < n; ++j) a[i][k] += changes[i][j] * other[j];
            }
        }
        for (size_t i = 0; i < m; ++i) a[i][i] *= 1.0 + 1e-12;
        for (size_t i = 0; i < m; ++i)  // positive definite: elimination without pivots
            for (size_t row = 0; row < m; ++row) {
                if (row == i || !(a[i][i] > 0.0)) continue;
                const double factor = a[row][i] / a[i][i];
                for (size_t k = i; k <= m; ++k) a[row][k] -= factor * a[i][k];
            }
        std::vector<double> step(n);
        for (size_t j = 0; j < n; ++j) step[j] = next[j] - x[j];
        for (size_t i = 0; i < m; ++i) {
            if (!(a[i][i] > 0.0)) continue;
            const double gamma = a[i][m] / a[i][i];
            for (size_t j = 0; j < n; ++j) step[j] -= gamma * (steps[i][j] + changes[i][j]);
        }
        for (size_t j = 0; j < n; ++j) x[j] += step[j];
        steps.push_back(std::move(step));
    }

    double dead_time_;
    int64_t whole_;       // of the dead time, in periods; the rest is
    int64_t delay_ = 0;   // ... whole bins
    double spill_ = 0.0;  // ... and a part of one
    bool converged_ = false, unique_ = true;
    std::vector<double> p_, q_;  // 1 - e^-l, and 1 - p / l: the same for a photon that re-arms inside the bin
    std::vector<double> below_;  // registrations per period before the edge of each part
};

}  // namespace mars
