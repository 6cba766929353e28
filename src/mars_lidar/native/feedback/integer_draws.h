// A batch of the feedback engine: from mean histograms to integer ones.
//
// Each draw gives every cell of the period a quantile of its count, as a linear function of its mean
// (feedback/quantile.h), and then sweeps round the circle until the integers repeat (feedback/sweeps.h): a history
// of all exposures' registrations that agrees with itself. What does not settle, or is not allowed by the law of its
// count, is refused and left to the exact engine (docs/feedback.md).
#pragma once
#include "feedback/output.h"
#include "feedback/pixels.h"
#include "feedback/remainder.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

constexpr uint64_t kDomain = 0x466565646261636bu;  // "Feedback": not another engine's numbers at one seed
constexpr uint32_t kEndEvent = 0xffffffffu;        // the counter, not a cell, of the state at the ends of the exposure

// Quantiles are taken anew where fewer exposures are armed, and more counts expected, or firing more likely.
constexpr float kFewArmed = 32.0f, kFewCounts = 0.03f, kLikely = 0.02f;

class Batch : private BatchPixels {
 public:
    explicit Batch(const FeedbackBatch& batch) : BatchPixels(batch) {}

    bool run() {
        solve_mean();
        bound_counts();
        ask_where_needed();
        choose_laps();
        int32_t most = 0;
        for (int i = 0; i < kTeam; ++i) most = batch_.draws[i] > most ? batch_.draws[i] : most;
        for (int32_t draw = 0; draw < most; ++draw) {
            if (batch_.stopped()) return true;
            bool some = false;
            for (int i = 0; i < kTeam; ++i) {
                drawing_[i] = draw < batch_.draws[i] && refused_[i] == FeedbackStatus::kDrawn;
                if (draw < batch_.draws[i]) status(i, draw) = refused_[i];
                some = some || drawing_[i];
            }
            if (!some) continue;
            draw_numbers(draw);
            start_history();
            const bool done = grid_.folded() > 0 ? sweep_integers<true, true>()
                              : grid_.stationary ? sweep_integers<false, true>()
                                                 : sweep_integers<false, false>();
            if (!done) return true;
            check_draws(draw);
            if (!write_histograms(batch_, work_.history[0], drawing_, draw)) return false;
            if (grid_.laps > 1 && !draw_remainders(draw)) return false;
        }
        return true;
    }

 private:
    FeedbackStatus& status(int i, int32_t draw) const { return batch_.status[i][draw * batch_.status_step]; }

    // Everything random of one draw: the quantiles of all cells, and the state at the ends of the exposure.
    void draw_numbers(int32_t draw) {
        responds_ = false;
        for (int i = 0; i < kTeam; ++i) {
            slow_[i] = drawing_[i] && grid_.laps == 1 && (grid_.folded() > 0 || rate_[i] > kLinearFrom) ? 1 : 0;
            responds_ = responds_ || slow_[i] != 0;
            const uint32_t realization = batch_.realization[i] + static_cast<uint32_t>(draw) * batch_.realization_step;
            const Pair<uint32_t> key = stream_key(batch_.seed ^ kDomain, realization, batch_.pixel_index[i]);
            key0_[i] = key.first;
            key1_[i] = key.second;
        }
        alignas(64) uint32_t words[kTeam], other[kTeam];
        Uniforms uniforms;
        for (int32_t lap = 0, t = 0; lap < grid_.laps; ++lap) {
            MeanLaw law(grid_, work_.rates, work_.sums, scale_);
            for (int32_t j = 0; j < n_; ++j, ++t) {
                draw_words(key0_, key1_, t, words, other);
                uniforms.set(words);
                law.next(j);
                work_.exact[static_cast<int64_t>(t) * kTeams] = law.rare(j, kFewArmed, kFewCounts, kLikely);
                uint16_t* dither = work_.dither + row(t);
                uint16_t* split = work_.split + row(t + 1);
                for (int i = 0; i < kTeam; ++i) {
                    dither[i] = static_cast<uint16_t>(other[i] >> 16);
                    split[i] = static_cast<uint16_t>(other[i] & 0xffffu);
                }
                float *const alpha = work_.alpha + row(t), *const beta = work_.beta + row(t);
                follow_quantile(law.mean, law.variance, work_.rates.fire(j), work_.rates.refire(j), grid_.laps > 1,
                                uniforms, alpha, beta);
                for (int i = 0; responds_ && i < kTeam; ++i)  // what the quantile adds to the mean, rounding included
                    work_.noise[row(j) + i] = (alpha[i] - 1.0f) * law.mean[i] + beta[i] + 0.5f;
            }
        }
        place_rearmed(grid_, work_.sums, scale_, work_.split);
        for (int i = 0; i < kTeam; ++i) {
            const int32_t edge = batch_.first_bin[i] == 0 ? 0 : grid_.bin_cell[grid_.bins - batch_.first_bin[i]];
            exposure_.edge[i] = edge;
            exposure_.active[i] = drawing_[i] ? -1 : 0;
            spare_[i] = late_[i] = exposure_.start[i] = exposure_.end[i] = 0;
            exposure_.rank[i] = static_cast<int32_t>(number_of_the_end(i, 1u) * pieces_[i]);
            if (grid_.folded() > 0) spare_[i] = blind_at_an_end(i, 1u, exposure_.end[i]);
            if (!grid_.stationary) continue;
            const int32_t blind = blind_at_an_end(i, 2u, exposure_.start[i]);
            if (shortened())
                late_[i] = blind;
            else if (grid_.laps > 1)
                exposure_.start[i] += blind * n_;
            else
                spare_[i] -= blind;
        }
    }

    double number_of_the_end(int i, uint32_t stage) const {
        const Pair<uint32_t> words = threefry<13, uint32_t>(kEndEvent, stage, key0_[i], key1_[i]);
        return (words.first + (words.second + 0.5) * 0x1p-32) * 0x1p-32;
    }

    int32_t blind_at_an_end(int i, uint32_t stage, int32_t& cells) const {
        const double u = number_of_the_end(i, stage);
        return blind_cells(grid_, work_.sums + i, total_[i], share_[i], exposure_.edge[i], u, cells);
    }

    // The first history: the mean, and the linear response to this draw's noise where sweeps contract slowly.
    void start_history() {
        alignas(64) float armed[kTeam], change[kTeam];
        alignas(64) int32_t active[kTeam];
        for (int i = 0; i < kTeam; ++i) {
            number_[i] = pieces_[i] * share_[i] * total_[i];
            active[i] = slow_[i];
        }
        float *old = work_.spare_sums, *fresh = work_.more_sums;
        if (responds_) {
            int32_t some = 1;
            double moved_by[kTeam] = {}, step_before[kTeam] = {}, damping[kTeam];  // N less its mean
            for (int i = 0; i < kTeam; ++i) damping[i] = 1.0;
            for (int64_t k = 0; k < row(n_ + 1); ++k) old[k] = 0.0f;
            for (int i = 0; i < kTeam; ++i) armed[i] = 0.0f;
            for (int sweep = 0; some && sweep < kLinearSweeps; ++sweep) {
                real_sweep<true>(grid_, work_.rates, armed, work_.alpha, work_.noise, active, old, fresh, change);
                std::swap(old, fresh);
                some = 0;
                for (int i = 0; i < kTeam; ++i) {
                    if (!active[i]) continue;
                    const double moved = (static_cast<double>(old[row(n_) + i]) - moved_by[i]) * share_[i];
                    moved_by[i] += damped(moved, step_before[i], damping[i]);
                    armed[i] = static_cast<float>(-grid_.folded() * moved_by[i]);
                    active[i] = change[i] > 0.5f || grid_.folded() * size(moved) > 0.25 ? 1 : 0;
                    some |= active[i];
                }
            }
            for (int i = 0; i < kTeam; ++i) number_[i] += moved_by[i];
        }
        round_sums(grid_, work_.sums, scale_, responds_ ? old : nullptr, slow_, work_.history[0]);
        set_blind();
    }

    // A step of N. By 1 / (1 + K sum w) it is right for a history that has settled; where sweeps settle slowly, the total
    // follows N by more than it will in the end, and N would swing for ever. So steps are halved where they turn back by
    // more than half of what they were.
    static double damped(double step, double& before, double& damping) {
        if (step * before < 0.0 && size(step) > 0.5 * size(before) && damping > 0.125) damping *= 0.5;
        before = step;
        return damping * step;
    }

    // K N is a real number here: rounded to an integer, the total would jump by sum w where K N steps by one.
    void set_blind() {
        for (int i = 0; i < kTeam; ++i) {
            const double blind = grid_.folded() * number_[i], whole = floor_of(blind);
            exposure_.armed[i] = pieces_[i] - static_cast<int32_t>(whole) + spare_[i];
            exposure_.part[i] = static_cast<float>(blind - whole);
        }
    }

    // Integer sweeps until the lanes' histories repeat. Returns false on stop.
    template <bool periods, bool warm>
    bool sweep_integers() {
        const Quantiles quantiles{work_.alpha, work_.beta, work_.dither, work_.split, work_.exact, key0_, key1_};
        alignas(64) int32_t change[kTeam];
        float last[kTeam];
        double step_before[kTeam] = {}, damping[kTeam];
        for (int i = 0; i < kTeam; ++i) damping[i] = 1.0;
        const int sweeps = grid_.laps > 1 ? kLapSweeps : kIntegerSweeps;
        const int64_t end = row(grid_.path());
        for (int i = 0; i < kTeam; ++i) last[i] = 0.0f;
        for (int sweep = 1; sweep <= sweeps; ++sweep) {
            if (batch_.stopped()) return false;
            integer_sweep<periods, warm>(grid_, work_.rates, quantiles, exposure_, work_.history[0], work_.history[1],
                                         change, negative_);
            std::swap(work_.history[0], work_.history[1]);
            bool some = false;
            for (int i = 0; i < kTeam; ++i) {
                if (!exposure_.active[i]) continue;
                double turn = 0.0;  // what the next sweep's total will move by
                if constexpr (periods) {
                    const double seen = static_cast<double>(static_cast<uint32_t>(work_.history[0][end + i]));
                    const double step = (seen - number_[i]) * share_[i];
                    turn = grid_.folded() * total_[i] * size(step);
                    number_[i] += damped(step, step_before[i], damping[i]);
                }
                const float moved = static_cast<float>(change[i]);
                const bool settled = grid_.laps > 1
                                         ? moved == 0.0f && sweep > 1
                                         : moved <= still_[i] || (sweep > 1 && moved * moved <= 0.25f * last[i]);
                last[i] = moved;
                const bool still = turn <= 0.5 * static_cast<double>(still_[i]);
                exposure_.active[i] = settled && still && sweep >= least_[i] ? 0 : -1;
                overdrawn_[i] = negative_[i] < 0;
                some = some || exposure_.active[i];
            }
            if (!some) break;
            if constexpr (periods) set_blind();
        }
        return true;
    }

    // Only a history that agrees with itself and with the law of its count is written.
    void check_draws(int32_t draw) {
        const int32_t* const total = work_.history[0] + row(grid_.path());
        for (int i = 0; i < kTeam; ++i) {
            if (!drawing_[i]) continue;
            const double mean = mean_[i] - floor_of(mean_[i] * 0x1p-32) * 0x1p32;
            const int32_t off = static_cast<int32_t>(static_cast<uint32_t>(total[i]) - static_cast<uint32_t>(mean));
            const int32_t size = off < 0 ? -1 - off : off;
            if (exposure_.active[i])
                status(i, draw) = FeedbackStatus::kUnsettled;
            else if (overdrawn_[i])
                status(i, draw) = FeedbackStatus::kNegative;
            else if (size > allowed_[i] || remaining(i) < 0.0)
                status(i, draw) = FeedbackStatus::kUnlikely;
            drawing_[i] = status(i, draw) == FeedbackStatus::kDrawn;
        }
    }

    // Periods of the exposure after its pieces.
    double remaining(int i) const {
        const double whole = shortened() ? grid_.whole : 0;
        const double taken =
            whole * static_cast<double>(static_cast<uint32_t>(work_.history[0][row(grid_.path()) + i]));
        return cycles() - static_cast<double>(pieces_[i]) * grid_.laps - taken - late_[i];
    }

    bool draw_remainders(int32_t draw) {
        bool fits = true;
        for (int i = 0; i < kTeam; ++i) {
            if (!drawing_[i]) continue;
            const Remainder rest(grid_, work_.history[0] + i, work_.photons + i, exposure_.edge[i], exposure_.rank[i],
                                 remaining(i), {key0_[i], key1_[i]});
            rest.walk([&](int32_t cell) { fits = add_registration(batch_, i, draw, cell) && fits; });
        }
        return fits;
    }

    Exposure exposure_;
    alignas(64) uint32_t key0_[kTeam], key1_[kTeam];
    alignas(64) int32_t negative_[kTeam];
    alignas(64) int32_t slow_[kTeam];  // 1: the lane begins with the linear response to its noise
    bool responds_;                    // some of them do
    bool drawing_[kTeam];
    bool overdrawn_[kTeam];  // fewer than no exposures armed in the last sweep
    int32_t spare_[kTeam];   // whole periods blind beyond the end, less those at the start
    int32_t late_[kTeam];    // whole periods blind at the start, of an exposure whose pieces leave them out
    double number_[kTeam];   // N of a piece, real
};

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
