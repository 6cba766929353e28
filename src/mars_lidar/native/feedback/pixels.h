// What a batch of the feedback engine knows of its pixels before anything is drawn: the mean histogram, how fast sweeps
// settle, how far a count may be from its mean, and whether and in how many laps the pixel can be drawn.
#pragma once
#include "feedback/laps.h"
#include "feedback/workspace.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

constexpr double kSettled = 0.04;    // a move of the history that ends a lane, in standard deviations of the count
constexpr double kMeanError = 8e-6;  // of the mean per period, or of a count: float32 sums, and the last sweep's change
constexpr float kSlowest =
    0.95f;  // contraction of a sweep beyond which, or more sweeps than integers have, several laps are needed
constexpr float kSlowFromPeriods = 0.85f;  // and from which ghosts count where whole periods of the dead time are blind
constexpr float kLinearFrom = 0.2f;        // and from which the linear response is worth its sweeps
constexpr double kLeastVariance = 12.0;    // of the count, for each whole period of dead time: 0.2 to 0.5 are added

class BatchPixels {
 protected:
    explicit BatchPixels(const FeedbackBatch& batch)
        : batch_(batch), grid_(*batch.grid), n_(batch.grid->cells), work_(batch) {
        for (int i = 0; i < kTeam; ++i) {
            refused_[i] = FeedbackStatus::kDrawn;
            needs_laps_[i] = false;
        }
    }

    int64_t row(int32_t j) const { return static_cast<int64_t>(j) * kRow; }
    static float clip(float x) { return x > 1e-12f ? x : 1e-12f; }
    static float lesser(float x, float y) { return x < y ? x : y; }
    static double size(double x) { return x < 0.0 ? -x : x; }
    double cycles() const { return grid_.cycles; }
    // Whether whole periods of the dead time are left out: pieces then take K periods more for each registration.
    bool shortened() const { return grid_.laps > 1 && grid_.whole > 0; }
    void refuse(int i, FeedbackStatus why) {
        if (refused_[i] == FeedbackStatus::kDrawn) refused_[i] = why;
    }

    // A first history for the mean: of every phase the same, so that none which is slow to be left is missing from the
    // measured contraction. sum p / (1 + sum p t_d) in all.
    void spread_evenly() {
        alignas(64) float fired[kTeam];
        float cells[kKinds] = {};  // of each kind without signal
        for (int32_t j = 0; j < n_; ++j)
            if (j < batch_.lit_begin || j >= batch_.lit_end) cells[grid_.kind[j]] += 1.0f;
        for (int i = 0; i < kTeam; ++i) fired[i] = 0.0f;
        for (int k = 0; k < kKinds; ++k)
            for (int i = 0; i < kTeam; ++i) fired[i] += cells[k] * work_.rates.dark_fire[k * kRow + i];
        for (int32_t j = batch_.lit_begin; j < batch_.lit_end; ++j) {
            const float* p = work_.rates.fire(j);
            for (int i = 0; i < kTeam; ++i) fired[i] += p[i];
        }
        const float rest = static_cast<float>(grid_.dead_time - grid_.whole);
        for (int i = 0; i < kTeam; ++i) fired[i] /= 1.0f + rest * fired[i];
        for (int32_t j = 0; j <= n_; ++j) {
            const float place = static_cast<float>(grid_.place[j]);
            float* sums = work_.sums + row(j);
            for (int i = 0; i < kTeam; ++i) sums[i] = place * fired[i];
        }
    }

    // w and sum w, by sweeps; how fast they contract.
    void solve_mean() {
        alignas(64) float ones[kTeam], change[kTeam];
        alignas(64) int32_t active[kTeam];
        float first[kTeam], last[kTeam];
        int32_t taken[kTeam];  // sweeps
        for (int i = 0; i < kTeam; ++i) {
            ones[i] = 1.0f;
            active[i] = 1;
            least_[i] = taken[i] = 1;
            rate_[i] = first[i] = last[i] = 0.0f;
            forgotten_[i] = 1;
        }
        spread_evenly();

        const double wanted = 0.1 / root(cycles() > 1e4 ? cycles() : 1e4);
        const float tolerance = wanted < 4e-6 ? 4e-6f : static_cast<float>(wanted);  // what float32 sums allow
        for (int sweep = 1; sweep <= kMeanSweeps; ++sweep) {
            real_sweep<false>(grid_, work_.rates, ones, nullptr, nullptr, active, work_.sums, work_.spare_sums, change);
            std::swap(work_.sums, work_.spare_sums);
            bool some = false;
            for (int i = 0; i < kTeam; ++i) {
                if (!active[i]) continue;
                taken[i] = sweep;
                const float moved = clip(change[i]);
                if (sweep == 1) first[i] = moved;
                if (moved > kForgotten * first[i]) forgotten_[i] = sweep + 1;
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
            if (active[i]) refuse(i, FeedbackStatus::kSlow);
            needs_laps_[i] = rate_[i] > kSlowest || taken[i] > kIntegerSweeps;
            total_[i] = static_cast<double>(work_.sums[row(n_) + i]);
            share_[i] = 1.0 / (1.0 + grid_.whole * total_[i]);
            set_pieces(i, cycles());
        }
    }

    // As many pieces as fit into so many periods of the exposure.
    void set_pieces(int i, double periods) {
        const double pieces = floor_of((shortened() ? periods * share_[i] : periods) / grid_.laps);
        pieces_[i] = pieces > 0.0 ? static_cast<int32_t>(pieces) : 0;
        scale_[i] = static_cast<float>(grid_.folded() > 0 ? pieces_[i] * share_[i] : pieces_[i]);
    }

    // How far a count may be from its mean: 8 standard deviations, the ends of the exposure, and the mean's own error.
    // Where sweeps settle slowly, or in laps, by the variance of the count's law; elsewhere by what a contraction of
    // rho allows it to be, N (1 + rho) / (1 - rho). Where whole periods of the dead time are blind, one lap finds the
    // total by a fixed point to half a count: pixels need several where the law is narrower. The pieces of several laps
    // are so few that they and the periods that their registrations take fit into the exposure.
    void bound_counts() {
        bool some = false;
        for (int i = 0; i < kTeam; ++i) some = some || variance_matters(i);
        double variance[kTeam];
        for (int i = 0; i < kTeam; ++i) fewest_[i] = static_cast<float>(pieces_[i]);
        MeanLaw law(grid_, work_.rates, work_.sums, scale_);
        for (int32_t j = 0; j < n_; ++j) {
            law.next(j);
            for (int i = 0; i < kTeam; ++i) fewest_[i] = lesser(law.armed[i], fewest_[i]);
            for (int i = 0; some && i < kTeam; ++i) work_.noise[row(j) + i] = law.variance[i];
        }
        if (some)
            count_variance(grid_, work_.rates, work_.noise, work_.spare_sums, work_.more_sums, work_.alpha, kMeanSweeps,
                           variance);
        for (int i = 0; i < kTeam; ++i) {
            mean_[i] = cycles() * share_[i] * total_[i];
            const double narrower = shortened() ? 1.0 : share_[i] * share_[i];
            const double law = variance_matters(i)
                                   ? variance[i] * grid_.laps * narrower
                                   : mean_[i] * static_cast<double>((1.0f + rate_[i]) / (1.0f - rate_[i]));
            if (grid_.folded() > 0 && law < kLeastVariance * grid_.folded()) needs_laps_[i] = true;
            deviation_[i] = root(law > 0.0 ? law : 0.0);
            const double error = kMeanError * cycles() * share_[i] * (total_[i] > 1.0 ? total_[i] : 1.0) /
                                 static_cast<double>(1.0f - lesser(rate_[i], kSlowest));
            const double most = 8.0 * deviation_[i] + 8.0 + 2.0 * total_[i] + error;
            if (shortened()) {
                set_pieces(i, cycles() - grid_.whole * (most + 2.0));
                mean_[i] = static_cast<double>(pieces_[i]) * grid_.laps * total_[i];
                if (pieces_[i] < kFewestPieces) refuse(i, FeedbackStatus::kFew);
            }
            if (!(most < 0x1p30)) refuse(i, FeedbackStatus::kSlow);
            allowed_[i] = static_cast<int32_t>(most < 0x1p30 ? most : 0.0);
            // what a last move leaves to be moved is rho / (1 - rho) times as much
            const double ahead = rate_[i] < 0.5f ? 1.0 : 2.0 - 2.0 * static_cast<double>(rate_[i]);
            const double still = variance_matters(i) ? kSettled * ahead * deviation_[i] : 0.0;
            still_[i] = still > 1.0 ? static_cast<float>(still) : 1.0f;
        }
    }

    bool variance_matters(int i) const { return grid_.folded() > 0 || grid_.laps > 1 || rate_[i] > kLinearFrom; }

    // Lanes for which one lap is not enough, or not this number, are refused with the number that is. Also how many
    // sweeps a lane goes through at least.
    void choose_laps() {
        alignas(64) float ghosts[kTeam];
        bool some = grid_.laps > 1;
        for (int i = 0; i < kTeam; ++i) {
            some = some || fewest_[i] < kFewestArmed || rate_[i] > kLinearFrom;
            // until what rounding did to the first history is forgotten to 3 %, as several laps do in one sweep
            least_[i] = 1;
            if (grid_.laps > 1) continue;
            for (float left = rate_[i]; left > 0.03f && least_[i] < kIntegerSweeps / 2; left *= rate_[i]) ++least_[i];
        }
        if (!some) return;
        if (grid_.whole > 0) {
            for (int i = 0; i < kTeam; ++i) {
                const float count = kModes * rate_[i];
                const bool slow = rate_[i] > kSlowFromPeriods && count > kGhostsOfDeviation * deviation_[i];
                const bool few = fewest_[i] < kFewestArmed;
                if (grid_.laps == 1 && (few || slow) && refused_[i] == FeedbackStatus::kDrawn) ask_for_laps(i);
            }
            return;
        }
        expected_ghosts(grid_, work_.rates, work_.sums, work_.spare_sums, rate_, ghosts);
        for (int i = 0; i < kTeam; ++i) {
            if (refused_[i] != FeedbackStatus::kDrawn) continue;
            if (grid_.laps == 1) {
                const bool few = fewest_[i] < kFewestArmed;
                const bool many = rate_[i] > kLinearFrom && ghosts[i] > kGhostsOfDeviation * deviation_[i];
                if (!few && !many) continue;
            }
            ask_for_laps(i);
        }
    }

    // Refuses a lane with the number of laps that it needs.
    void ask_for_laps(int i) {
        const int32_t laps = laps_needed(forgotten_[i]);
        if (laps == grid_.laps) return;
        const double periods = cycles() * share_[i];  // without those that registrations take
        const bool short_of = periods < kFewestLapCycles || periods < kFewestPieces * laps;
        refuse(i, laps > kMostLaps ? FeedbackStatus::kSlow
                  : short_of       ? FeedbackStatus::kFew
                                   : static_cast<FeedbackStatus>(static_cast<int>(FeedbackStatus::kLaps) + laps));
    }
    void ask_where_needed() {
        for (int i = 0; i < kTeam; ++i)
            if (needs_laps_[i] && grid_.laps == 1) ask_for_laps(i);
    }

    const FeedbackBatch& batch_;
    const FeedbackGrid& grid_;
    const int32_t n_;
    Workspace work_;
    FeedbackStatus refused_[kTeam];    // all draws of a lane
    bool needs_laps_[kTeam];           // whatever its ghosts
    alignas(64) float rate_[kTeam];    // contraction of a sweep
    alignas(64) float scale_[kTeam];   // M / (1 + K sum w): exposures for each unit of w
    int32_t forgotten_[kTeam];         // sweep by which the mean has forgotten its start
    int32_t least_[kTeam];             // integer sweeps, at least
    alignas(64) float fewest_[kTeam];  // exposures armed in any cell
    int32_t pieces_[kTeam];            // of the exposure: N_r with one lap
    double total_[kTeam];              // sum w
    double share_[kTeam];              // 1 / (1 + K sum w)
    double mean_[kTeam];               // of the count of the exposure, or of its pieces
    double deviation_[kTeam];          // its standard deviation, or a bound
    int32_t allowed_[kTeam];           // by how much a count may differ
    float still_[kTeam];               // a move of the history that ends a lane's sweeps
};

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
