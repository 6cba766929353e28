// A batch of the feedback engine: from mean histograms to integer ones.
#pragma once
#include "feedback_output.h"
#include "feedback_workspace.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

constexpr uint64_t kDomain = 0x466565646261636bu;  // "Feedback": not another engine's numbers at one seed
constexpr uint32_t kEndEvent = 0xffffffffu;        // the counter, not a cell, of the state at the ends of the exposure

constexpr int kMeanSweeps = 40, kLinearSweeps = 60, kIntegerSweeps = 40;
constexpr float kSlowest = 0.85f;      // contraction of a sweep beyond which a pixel is refused
constexpr float kLinearFrom = 0.1f;    // and from which the linear response is worth its sweeps
constexpr double kLeastVariance = 12.0;  // of the count, for each whole period of dead time: 0.2 to 0.5 are added
constexpr float kFewArmed = 32.0f, kFewCounts = 0.03f;  // quantiles are taken anew below this many exposures armed

class Batch {
public:
    explicit Batch(const FeedbackBatch& batch)
        : batch_(batch), grid_(*batch.grid), n_(batch.grid->cells), work_(batch) {}

    bool run() {
        solve_mean();
        if (grid_.whole > 0) refuse_locked();
        int32_t most = 0;
        for (int i = 0; i < kTeam; ++i) most = batch_.draws[i] > most ? batch_.draws[i] : most;
        for (int32_t draw = 0; draw < most; ++draw) {
            if (batch_.stopped()) return true;
            bool some = false;
            for (int i = 0; i < kTeam; ++i) {
                drawing_[i] = draw < batch_.draws[i] && batch_.status[i] == FeedbackStatus::kDrawn;
                some = some || drawing_[i];
            }
            if (!some) break;
            draw_numbers(draw);
            start_history();
            if (!sweep_integers()) return true;
            if (!write_histograms(batch_, work_.history[0], drawing_, draw)) return false;
        }
        return true;
    }

private:
    int64_t row(int32_t j) const { return static_cast<int64_t>(j) * kRow; }
    static float clip(float x) { return x > 1e-12f ? x : 1e-12f; }
    static float lesser(float x, float y) { return x < y ? x : y; }
    static double size(double x) { return x < 0.0 ? -x : x; }

    // w and sum w, by sweeps from nothing; how fast they contract.
    void solve_mean() {
        alignas(64) float ones[kTeam], change[kTeam];
        alignas(64) int32_t active[kTeam];
        float first[kTeam], last[kTeam];
        for (int i = 0; i < kTeam; ++i) {
            ones[i] = 1.0f;
            active[i] = 1;
            least_[i] = 1;
            rate_[i] = first[i] = last[i] = 0.0f;
        }
        for (int64_t k = 0; k < row(n_ + 1); ++k) work_.sums[k] = 0.0f;

        const double wanted = 0.1 / root(static_cast<double>(grid_.cycles > 10000 ? grid_.cycles : 10000));
        const float tolerance = wanted < 4e-6 ? 4e-6f : static_cast<float>(wanted);  // what float32 sums allow
        for (int sweep = 1; sweep <= kMeanSweeps; ++sweep) {
            real_sweep<false>(grid_, work_.rates, ones, nullptr, nullptr, active, work_.sums, work_.spare_sums, change);
            std::swap(work_.sums, work_.spare_sums);
            bool some = false;
            for (int i = 0; i < kTeam; ++i) {
                if (!active[i]) continue;
                const float moved = clip(change[i]);
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
            total_[i] = static_cast<double>(work_.sums[row(n_) + i]);
            share_[i] = 1.0 / (1.0 + grid_.whole * total_[i]);
            scale_[i] = static_cast<float>(grid_.cycles * share_[i]);
        }
    }

    // Where whole periods of the dead time are blind, the total is found by a fixed point, to half a count.
    void refuse_locked() {
        MeanLaw law(grid_, work_.rates, work_.sums, scale_);
        for (int32_t j = 0; j < n_; ++j) {
            law.next(j);
            for (int i = 0; i < kTeam; ++i) work_.noise[row(j) + i] = law.variance[i];
        }
        double variance[kTeam];
        count_variance(grid_, work_.rates, work_.noise, work_.spare_sums, work_.more_sums, work_.alpha, kMeanSweeps,
                       variance);
        for (int i = 0; i < kTeam; ++i)
            if (variance[i] * share_[i] * share_[i] < kLeastVariance * grid_.whole)
                batch_.status[i] = FeedbackStatus::kLocked;
    }

    // Everything random of one draw: the quantiles of all cells, and the state at the ends of the exposure.
    void draw_numbers(int32_t draw) {
        for (int i = 0; i < kTeam; ++i) {
            const uint32_t realization = batch_.realization[i] + static_cast<uint32_t>(draw) * batch_.realization_step;
            const Pair<uint32_t> key = stream_key(batch_.seed ^ kDomain, realization, batch_.pixel_index[i]);
            key0_[i] = key.first;
            key1_[i] = key.second;
        }
        alignas(64) uint32_t words[kTeam], other[kTeam];
        Uniforms uniforms;
        MeanLaw law(grid_, work_.rates, work_.sums, scale_);
        for (int32_t j = 0; j < n_; ++j) {
            draw_words(key0_, key1_, j, words, other);
            uniforms.set(words);
            law.next(j);
            work_.exact[static_cast<int64_t>(j) * kTeams] = law.rare(kFewArmed, kFewCounts);
            uint16_t* dither = work_.dither + row(j);
            for (int i = 0; i < kTeam; ++i) dither[i] = static_cast<uint16_t>(other[i] >> 16);
            follow_quantile(law.mean, law.variance, uniforms, work_.alpha + row(j), work_.beta + row(j));
        }
        for (int i = 0; i < kTeam; ++i) {
            const int32_t begin = batch_.first_bin[i] == 0 ? 0 : grid_.bin_cell[grid_.bins - batch_.first_bin[i]];
            exposure_.place[i] = begin == 0 ? 0 : n_ - begin;
            exposure_.active[i] = drawing_[i] ? -1 : 0;
            spare_[i] = blind_at_an_end(i, begin, 1u, exposure_.end[i]);
            exposure_.start[i] = 0;
            if (grid_.stationary) spare_[i] -= blind_at_an_end(i, begin, 2u, exposure_.start[i]);
        }
    }

    int32_t blind_at_an_end(int i, int32_t begin, uint32_t stage, int32_t& cells) const {
        const Pair<uint32_t> words = threefry<13, uint32_t>(kEndEvent, stage, key0_[i], key1_[i]);
        const double u = (words.first + (words.second + 0.5) * 0x1p-32) * 0x1p-32;
        return blind_cells(grid_, work_.sums + i, total_[i], share_[i], begin, u, cells);
    }

    // The first history: the mean, and the linear response to this draw's noise where sweeps contract slowly.
    void start_history() {
        alignas(64) float armed[kTeam], change[kTeam];
        alignas(64) int32_t slow[kTeam], active[kTeam];
        int32_t some = 0;
        for (int i = 0; i < kTeam; ++i) {
            number_[i] = grid_.cycles * share_[i] * total_[i];
            slow[i] = active[i] = drawing_[i] && (grid_.whole > 0 || rate_[i] > kLinearFrom) ? 1 : 0;
            some |= active[i];
        }
        float *old = work_.spare_sums, *fresh = work_.more_sums;
        const bool respond = some != 0;
        if (respond) {
            set_noise();
            double moved_by[kTeam] = {};  // N less its mean
            for (int64_t k = 0; k < row(n_ + 1); ++k) old[k] = 0.0f;
            for (int i = 0; i < kTeam; ++i) armed[i] = 0.0f;
            for (int sweep = 0; some && sweep < kLinearSweeps; ++sweep) {
                real_sweep<true>(grid_, work_.rates, armed, work_.alpha, work_.noise, active, old, fresh, change);
                std::swap(old, fresh);
                some = 0;
                for (int i = 0; i < kTeam; ++i) {
                    if (!active[i]) continue;
                    const double moved = (static_cast<double>(old[row(n_) + i]) - moved_by[i]) * share_[i];
                    moved_by[i] += moved;
                    armed[i] = static_cast<float>(-grid_.whole * moved_by[i]);
                    active[i] = change[i] > 0.5f || grid_.whole * size(moved) > 0.25 ? 1 : 0;
                    some |= active[i];
                }
            }
            for (int i = 0; i < kTeam; ++i) number_[i] += moved_by[i];
        }
        round_sums(n_, work_.sums, scale_, respond ? old : nullptr, slow, work_.history[0]);
        set_blind();
    }

    // What the quantiles add to their means, rounding included on average.
    void set_noise() {
        MeanLaw law(grid_, work_.rates, work_.sums, scale_);
        for (int32_t j = 0; j < n_; ++j) {
            law.next(j);
            const float *alpha = work_.alpha + row(j), *beta = work_.beta + row(j);
            float* noise = work_.noise + row(j);
            for (int i = 0; i < kTeam; ++i) noise[i] = (alpha[i] - 1.0f) * law.mean[i] + beta[i] + 0.5f;
        }
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
        const Quantiles quantiles{work_.alpha, work_.beta, work_.dither, work_.exact, key0_, key1_};
        alignas(64) int32_t change[kTeam];
        float last[kTeam];
        for (int i = 0; i < kTeam; ++i) last[i] = 0.0f;
        for (int sweep = 1; sweep <= kIntegerSweeps; ++sweep) {
            if (batch_.stopped()) return false;
            integer_sweep(grid_, work_.rates, quantiles, exposure_, work_.history[0], work_.history[1], change);
            std::swap(work_.history[0], work_.history[1]);
            bool some = false;
            for (int i = 0; i < kTeam; ++i) {
                if (!exposure_.active[i]) continue;
                double turn = 0.0;  // what the next sweep's total will move by
                if (grid_.whole > 0) {
                    const double seen = static_cast<double>(static_cast<uint32_t>(work_.history[0][row(n_) + i]));
                    const double step = (seen - number_[i]) * share_[i];
                    turn = grid_.whole * total_[i] * size(step);
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
    Workspace work_;
    Exposure exposure_;
    alignas(64) uint32_t key0_[kTeam], key1_[kTeam];
    bool drawing_[kTeam];
    float rate_[kTeam];      // contraction of a sweep
    int32_t least_[kTeam];   // integer sweeps, at least
    int32_t spare_[kTeam];   // whole periods blind beyond the end, less those at the start
    double total_[kTeam];    // sum w
    double share_[kTeam];    // 1 / (1 + K sum w)
    double number_[kTeam];   // N, real
    alignas(64) float scale_[kTeam];  // N_r / (1 + K sum w): exposures for each unit of w
};

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
