// The feedback engine at one vector level: a batch of lanes from their mean histograms to integer ones.
#include "feedback_kernel.h"

#include <type_traits>
#include <utility>

#include "feedback_laws.h"
#include "feedback_output.h"
#include "feedback_sweeps.h"

#define MARS_JOIN2(a, b) a##b
#define MARS_JOIN(a, b) MARS_JOIN2(a, b)

namespace mars {
inline namespace MARS_LEVEL {
namespace {

constexpr uint64_t kDomain = 0x466565646261636bu;  // "Feedback": not another engine's numbers at one seed
constexpr uint32_t kEndEvent = 0xffffffffu;        // the counter, not a bin, of the state at the ends of the exposure

constexpr int kMeanSweeps = 40, kLinearSweeps = 60, kIntegerSweeps = 40;
constexpr float kSlowest = 0.85f;      // contraction of a sweep beyond which a pixel is refused
constexpr float kLinearFrom = 0.1f;    // and from which the linear response is worth its sweeps
constexpr double kLeastVariance = 12.0;  // of the count, for each whole period of dead time: 0.2 to 0.5 are added
constexpr double kFewArmed = 32.0, kFewCounts = 0.03;  // quantiles are taken anew below this many exposures armed

template <class Real>
class Batch {
public:
    explicit Batch(const FeedbackBatch& batch) : batch_(batch), grid_(*batch.grid), n_(batch.grid->bins) {
        const size_t rows = static_cast<size_t>(n_) * kTeam;
        const size_t lit = static_cast<size_t>(batch.lit_end - batch.lit_begin) * kTeam;
        const size_t reals = 2 * kTeam + 2 * lit + 4 * rows + 4 * (rows + kTeam);
        const size_t integers = 2 * (rows + kTeam) * 4 + rows * 2 + static_cast<size_t>(n_) * 4;
        const size_t bytes = reals * sizeof(Real) + integers + 64 * 32;  // with room to align every array
        if (batch.memory->size() < bytes) batch.memory->resize(bytes);
        unsigned char* at = batch.memory->data();
        auto take = [&at](auto*& pointer, size_t count) {
            at += (64 - reinterpret_cast<uintptr_t>(at) % 64) % 64;
            pointer = reinterpret_cast<std::remove_reference_t<decltype(pointer)>>(at);
            at += count * sizeof(*pointer);
        };
        Real *dark_fire, *dark_refire, *lit_fire, *lit_refire;
        take(dark_fire, kTeam);
        take(dark_refire, kTeam);
        take(lit_fire, lit);
        take(lit_refire, lit);
        set_rates(batch.dark_photons, kTeam, dark_fire, dark_refire);
        set_rates(batch.lit_photons, lit, lit_fire, lit_refire);
        rates_ = {batch.lit_begin, batch.lit_end, dark_fire, dark_refire, lit_fire, lit_refire};
        take(mean_, rows);
        take(variance_, rows);
        take(alpha_, rows);
        take(beta_, rows);
        for (Real*& sums : real_sums_) take(sums, rows + kTeam);
        for (int32_t*& sums : sums_) take(sums, rows + kTeam);
        take(dither_, rows);
        take(exact_, static_cast<size_t>(n_));
    }

    bool run() {
        solve_mean();
        linearise();
        if (grid_.whole > 0) refuse_locked();
        int32_t most = 0;
        for (int i = 0; i < kTeam; ++i) most = batch_.draws[i] > most ? batch_.draws[i] : most;
        for (int32_t draw = 0; draw < most; ++draw) {
            if (batch_.stop->load(std::memory_order_relaxed)) return true;
            bool some = false;
            for (int i = 0; i < kTeam; ++i) {
                drawing_[i] = draw < batch_.draws[i] && batch_.status[i] == FeedbackStatus::kDrawn;
                some = some || drawing_[i];
            }
            if (!some) break;
            draw_numbers(draw);
            start_history();
            if (!sweep_integers()) return true;
            if (!write_histograms(batch_, sums_[0], drawing_, draw)) return false;
        }
        return true;
    }

private:
    int64_t row(int32_t j) const { return static_cast<int64_t>(j) * kTeam; }

    // w and sum w, by sweeps from nothing; how fast they contract.
    void solve_mean() {
        Real *old = real_sums_[0], *fresh = real_sums_[1];
        alignas(64) Real ones[kTeam], change[kTeam];
        alignas(64) int32_t active[kTeam];
        float first[kTeam], last[kTeam];
        for (int i = 0; i < kTeam; ++i) {
            ones[i] = 1;
            active[i] = 1;
            least_[i] = 1;
            rate_[i] = first[i] = last[i] = 0.0f;
        }
        for (int64_t k = 0; k < row(n_ + 1); ++k) old[k] = 0;

        const double wanted = 0.1 / root(static_cast<double>(grid_.cycles > 10000 ? grid_.cycles : 10000));
        const Real tolerance = static_cast<Real>(sizeof(Real) == 4 && wanted < 4e-6 ? 4e-6 : wanted);
        for (int sweep = 1; sweep <= kMeanSweeps; ++sweep) {
            real_sweep<Real>(grid_, rates_, ones, nullptr, nullptr, active, old, fresh, change);
            std::swap(old, fresh);
            bool some = false;
            for (int i = 0; i < kTeam; ++i) {
                if (!active[i]) continue;
                const float moved = clip(static_cast<float>(change[i]));
                if (sweep == 1) first[i] = moved;
                if (change[i] <= tolerance && sweep > 1) {
                    active[i] = 0;
                    const float once = moved / last[i];
                    const float often = exp_of(lesser(log_of(moved / first[i]) / static_cast<float>(sweep - 1), 0.0f));
                    rate_[i] = once > often ? once : often;
                } else {
                    some = true;
                }
                last[i] = moved;
            }
            if (!some) break;
        }
        for (int i = 0; i < kTeam; ++i) {
            if (active[i] || rate_[i] > kSlowest) batch_.status[i] = FeedbackStatus::kSlow;
            // sweeps until what rounding did to the first history is forgotten to 3 %
            for (float left = rate_[i]; left > 0.03f && least_[i] < kIntegerSweeps / 2; left *= rate_[i]) ++least_[i];
            total_[i] = static_cast<double>(old[row(n_) + i]);
            share_[i] = 1.0 / (1.0 + grid_.whole * total_[i]);
        }
        mean_sums_ = old;
        spare_sums_ = fresh;
    }

    static float clip(float x) { return x > 1e-12f ? x : 1e-12f; }
    static float lesser(float x, float y) { return x < y ? x : y; }

    // Mean and variance of every bin's count given its past, at the means; where quantiles cannot be followed.
    void linearise() {
        const History<Real> history(mean_sums_, mean_sums_, n_);
        const Real f = static_cast<Real>(grid_.fraction), g = Real(1) - f;
        const int32_t d = grid_.shift;
        alignas(64) Real re[kTeam], scale[kTeam];
        for (int i = 0; i < kTeam; ++i) {
            const Real at = d == n_ ? -history.total[i] : history.row(-d)[i] - history.total[i];
            re[i] = g * at + f * before_history(history, d, i);
            scale[i] = static_cast<Real>(grid_.cycles * share_[i]);
        }
        for (int32_t j = 0; j < n_; ++j) {
            const Real *p = rates_.fire(j), *q = rates_.refire(j);
            const Real *late = history.row(j + 1 - d), *late_less = history.less(j + 1 - d);
            const Real *early = history.row(j - d), *early_less = history.less(j - d);
            const Real* here = mean_sums_ + row(j);
            Real *mean = mean_ + row(j), *variance = variance_ + row(j);
            uint32_t exact = 0;
            for (int i = 0; i < kTeam; ++i) {
                const Real next = g * (late[i] - late_less[i]) + f * (early[i] - early_less[i]);
                Real armed = scale[i] * (Real(1) - (here[i] - re[i])), in = scale[i] * (next - re[i]);
                armed = armed > Real(0) ? armed : Real(0);
                in = in > Real(0) ? in : Real(0);
                re[i] = next;
                mean[i] = p[i] * armed + q[i] * in;
                variance[i] = p[i] * (Real(1) - p[i]) * armed + q[i] * (Real(1) - q[i]) * in;
                exact |= static_cast<uint32_t>(armed < Real(kFewArmed) && mean[i] > Real(kFewCounts)) << i;
            }
            exact_[j] = exact;
        }
    }

    // Where whole periods of the dead time are blind, the total is found by a fixed point, to half a count.
    void refuse_locked() {
        double variance[kTeam];
        count_variance<Real>(grid_, rates_, variance_, spare_sums_, real_sums_[2], real_sums_[3], kMeanSweeps,
                             variance);
        for (int i = 0; i < kTeam; ++i)
            if (variance[i] * share_[i] * share_[i] < kLeastVariance * grid_.whole)
                batch_.status[i] = FeedbackStatus::kLocked;
    }

    // Everything random of one draw: the quantiles of all bins, and the state at the ends of the exposure.
    void draw_numbers(int32_t draw) {
        alignas(64) uint32_t words[kTeam], other[kTeam];
        for (int i = 0; i < kTeam; ++i) {
            const uint32_t realization = batch_.realization[i] + static_cast<uint32_t>(draw) * batch_.realization_step;
            const Pair<uint32_t> key = stream_key(batch_.seed ^ kDomain, realization, batch_.pixel_index[i]);
            key0_[i] = key.first;
            key1_[i] = key.second;
        }
        Uniforms uniforms;
        for (int32_t j = 0; j < n_; ++j) {
            draw_words(key0_, key1_, j, words, other);
            uniforms.set(words);
            uint16_t* dither = dither_ + row(j);
            for (int i = 0; i < kTeam; ++i) dither[i] = static_cast<uint16_t>(other[i] >> 16);
            follow_quantile(mean_ + row(j), variance_ + row(j), uniforms, alpha_ + row(j), beta_ + row(j));
        }
        for (int i = 0; i < kTeam; ++i) {
            exposure_.place[i] = batch_.first_bin[i];
            exposure_.active[i] = drawing_[i] ? -1 : 0;
            spare_[i] = blind_at_an_end(i, 1u, exposure_.end[i]);
            exposure_.start[i] = 0;
            if (grid_.stationary) spare_[i] -= blind_at_an_end(i, 2u, exposure_.start[i]);
        }
    }

    int32_t blind_at_an_end(int i, uint32_t stage, int32_t& bins) const {
        const Pair<uint32_t> words = threefry<13, uint32_t>(kEndEvent, stage, key0_[i], key1_[i]);
        const double u = (words.first + (words.second + 0.5) * 0x1p-32) * 0x1p-32;
        return blind_bins(grid_, mean_sums_ + i, total_[i], share_[i], batch_.first_bin[i], u, bins);
    }

    // The first history: the mean, and the linear response to this draw's noise where sweeps contract slowly.
    void start_history() {
        Real *old = spare_sums_, *fresh = real_sums_[2];
        alignas(64) Real armed[kTeam], change[kTeam], scale[kTeam];
        alignas(64) int32_t active[kTeam];
        int32_t some = 0;
        for (int i = 0; i < kTeam; ++i) {
            number_[i] = grid_.cycles * share_[i] * total_[i];
            armed[i] = static_cast<Real>(grid_.cycles - grid_.whole * number_[i]);
            active[i] = drawing_[i] && (grid_.whole > 0 || rate_[i] > kLinearFrom) ? 1 : 0;
            scale[i] = static_cast<Real>(grid_.cycles * share_[i]);
            some |= active[i];
        }
        const Real* sums = mean_sums_;
        if (some) {
            for (int32_t j = 0; j <= n_; ++j)
                for (int i = 0; i < kTeam; ++i) old[row(j) + i] = mean_sums_[row(j) + i] * scale[i];
            for (int sweep = 0; some && sweep < kLinearSweeps; ++sweep) {
                real_sweep<Real>(grid_, rates_, armed, alpha_, beta_, active, old, fresh, change);
                std::swap(old, fresh);
                some = 0;
                for (int i = 0; i < kTeam; ++i) {
                    if (!active[i]) continue;
                    const double moved = (static_cast<double>(old[row(n_) + i]) - number_[i]) * share_[i];
                    number_[i] += moved;
                    armed[i] = static_cast<Real>(grid_.cycles - grid_.whole * number_[i]);
                    const double turn = grid_.whole * (moved < 0.0 ? -moved : moved);
                    active[i] = change[i] > Real(0.5) || turn > 0.25 ? 1 : 0;
                    some |= active[i];
                }
            }
            for (int i = 0; i < kTeam; ++i) scale[i] = 1;
            sums = old;
        }
        int32_t* history = sums_[0];
        for (int32_t j = 0; j <= n_; ++j)
            for (int i = 0; i < kTeam; ++i)
                history[row(j) + i] = static_cast<int32_t>(static_cast<uint32_t>(
                    static_cast<int64_t>(static_cast<double>(sums[row(j) + i]) * static_cast<double>(scale[i]) + 0.5)));
        set_blind();
    }

    // K N is a real number here: rounded to an integer, the total would jump by sum w where K N steps by one.
    void set_blind() {
        for (int i = 0; i < kTeam; ++i) {
            const double blind = grid_.whole * number_[i], whole = floor_of(blind);
            exposure_.armed[i] = grid_.cycles - static_cast<int32_t>(whole) + spare_[i];
            exposure_.part[i] = static_cast<float>(blind - whole);
        }
    }

    // Integer sweeps until the lanes' histories repeat. Returns false on stop.
    bool sweep_integers() {
        const Quantiles<Real> quantiles{alpha_, beta_, dither_, exact_, key0_, key1_};
        alignas(64) int32_t change[kTeam];
        float last[kTeam];
        for (int i = 0; i < kTeam; ++i) last[i] = 0.0f;
        for (int sweep = 1; sweep <= kIntegerSweeps; ++sweep) {
            if (batch_.stop->load(std::memory_order_relaxed)) return false;
            integer_sweep<Real>(grid_, rates_, quantiles, exposure_, sums_[0], sums_[1], change);
            std::swap(sums_[0], sums_[1]);
            bool some = false;
            for (int i = 0; i < kTeam; ++i) {
                if (!exposure_.active[i]) continue;
                double turn = 0.0;  // what the next sweep's total will move by
                if (grid_.whole > 0) {
                    const double seen = static_cast<double>(static_cast<uint32_t>(sums_[0][row(n_) + i]));
                    const double step = (seen - number_[i]) * share_[i];
                    turn = grid_.whole * total_[i] * (step < 0.0 ? -step : step);
                    number_[i] += step;
                }
                const float moved = static_cast<float>(change[i]);
                const bool settled = moved <= 1.0f || (sweep > 1 && moved * moved <= 0.25f * last[i]);
                last[i] = moved;
                exposure_.active[i] = settled && turn <= 0.5 && sweep >= least_[i] ? 0 : -1;
                some = some || exposure_.active[i];
            }
            if (!some) break;
            if (grid_.whole > 0) set_blind();
        }
        return true;
    }

    const FeedbackBatch& batch_;
    const FeedbackGrid& grid_;
    const int32_t n_;
    Rates<Real> rates_;
    Real *mean_, *variance_, *alpha_, *beta_, *real_sums_[4];
    int32_t* sums_[2];
    uint16_t* dither_;
    uint32_t* exact_;
    const Real* mean_sums_ = nullptr;
    Real* spare_sums_ = nullptr;
    Exposure exposure_;
    alignas(64) uint32_t key0_[kTeam], key1_[kTeam];
    bool drawing_[kTeam];
    float rate_[kTeam];      // contraction of a sweep
    int32_t least_[kTeam];   // integer sweeps, at least
    int32_t spare_[kTeam];   // whole periods blind beyond the end, less those at the start
    double total_[kTeam];    // sum w
    double share_[kTeam];    // 1 / (1 + K sum w)
    double number_[kTeam];   // N, real
};

// Cycles up to which float32 carries counts to a small part of their standard deviation.
constexpr int32_t kFloatCycles = 1 << 20;

}  // namespace
}  // namespace MARS_LEVEL

bool MARS_JOIN(feedback_kernel_, MARS_LEVEL)(const FeedbackBatch& batch) {
    return batch.grid->cycles <= kFloatCycles ? Batch<float>(batch).run() : Batch<double>(batch).run();
}

}  // namespace mars
