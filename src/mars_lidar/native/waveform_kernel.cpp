// The kernel of waveforms: waits are drawn ahead in vectors, and then looked up in the pixel's table one by one.
//
// The chain from one registration to the next is some 80 cycles long (a look-up of C, one of its inverse, a division),
// far longer than its instructions take. So a team of items takes turns: while one waits for its tables the others
// compute. Scalar double precision in the chain: what is gathered from the tables of different pixels gains nothing
// from vectors.
#include "waveform_kernel.h"

#include "registration.h"
#include "waveform_modes.h"
#include "waveform_table.h"

#define MARS_JOIN2(a, b) a##b
#define MARS_JOIN(a, b) MARS_JOIN2(a, b)

namespace mars {
inline namespace MARS_LEVEL {
namespace {

constexpr int kTeam = kWaveformTeam;
constexpr int kWaits = 32;        // drawn ahead; a multiple of every number of lanes
constexpr int kPollWaveform = 512;  // rounds between looks at `stop`

// Waits of one item's next registrations.
struct Waits {
    double energy[kWaits];  // photons beyond the whole periods
    int32_t whole[kWaits];
};

MARS_INLINE void draw_ahead(Waits& to, const Pair<uint32_t>& key, uint32_t event, double total) {
    float exponentials[kWaits];
    uint32_t fresh[kWaits], count[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) count[lane] = event + static_cast<uint32_t>(lane);
    const UInt key0 = splat(key.first), key1 = splat(key.second), stage = splat(kStageArrival);
    UInt events = load<UInt>(count);
    for (int k = 0; k < kWaits; k += kLanes) {
        const Pair<UInt> words = threefry<13>(events, stage, key0, key1);
        store(exponentials + k, exponential(words.first));
        store(fresh + k, words.second);
        events = events + static_cast<uint32_t>(kLanes);
    }
    const double inverse = 1.0 / total;
    int32_t longest = 0;
    for (int k = 0; k < kWaits; ++k) {
        const double wait = static_cast<double>(exponentials[k]) * inverse;
        const double periods = wait < static_cast<double>(kForever) ? wait : static_cast<double>(kForever);
        const int32_t whole = static_cast<int32_t>(periods);
        to.whole[k] = whole;
        to.energy[k] = (periods - static_cast<double>(whole)) * total;
        longest = whole > longest ? whole : longest;
    }
    if (longest < static_cast<int32_t>(kLongWait)) return;
    for (int k = 0; k < kWaits; ++k) {  // a fresh fraction: `refresh` of registration.h
        if (to.whole[k] < static_cast<int32_t>(kLongWait)) continue;
        const double v = (fresh[k] + 0.5) * 0x1p-32;
        to.energy[k] = total * (v - 0.5 * total * v * (1.0 - v) * (1.0 - total * (1.0 - 2.0 * v) / 3.0));
    }
}

// Where the registrations of one item go.
template <Sink sink>
struct Output;

template <>
struct Output<Sink::kCounts> {
    int64_t* count;

    void open(const WaveformBlock& block, int64_t item) {
        count = static_cast<int64_t*>(block.out) + item;
        *count = 0;
    }
    MARS_INLINE void write(int32_t, double, int32_t) { ++*count; }
};

template <class Count>
struct Row {
    Count* row;

    void open(const WaveformBlock& block, int64_t item) {
        const size_t bins = static_cast<size_t>(block.job->bins);
        row = static_cast<Count*>(block.out) + static_cast<size_t>(item) * bins;
        memset(row, 0, bins * sizeof(Count));
    }
    MARS_INLINE void write(int32_t, double, int32_t bin) { ++row[bin]; }
};

template <>
struct Output<Sink::kHistogram16> : Row<uint16_t> {};
template <>
struct Output<Sink::kHistogram32> : Row<uint32_t> {};

template <>
struct Output<Sink::kTimestamps> {
    double* times;
    int32_t *cycles, *bins;

    void open(const WaveformBlock& block, int64_t item) {
        const int64_t first = block.offsets[item];
        times = block.times + first;
        cycles = block.cycles + first;
        bins = block.bins + first;
    }
    MARS_INLINE void write(int32_t cycle, double phase, int32_t bin) {
        *times++ = static_cast<double>(cycle) + phase;
        *cycles++ = cycle;
        *bins++ = bin;
    }
};

template <class Mode, Sink sink, class Index>
class WaveformRunner {
public:
    explicit WaveformRunner(const WaveformBlock& block)
        : block_(block), job_(*block.job), mode_(job_, static_cast<double>(job_.samples)),
          bins_per_part_(static_cast<double>(job_.bins) / static_cast<double>(job_.samples)),
          periods_per_part_(1.0 / static_cast<double>(job_.samples)) {
        const int64_t edges = edges_of(job_.samples), cells = cells_of(job_.samples);
        for (int k = 0; k < kTeam; ++k) {
            tables_[k].edge = block.edges + k * edges;
            tables_[k].guide = reinterpret_cast<Index*>(block.guides + k * cells);
        }
    }

    void run() {
        while (busy_ < kTeam && take(team_[busy_])) ++busy_;
        for (int round = 1; busy_ > 0; ++round) {
            for (int k = 0; k < busy_; ++k) draw_ahead(team_[k].waits, team_[k].key, team_[k].event, total(team_[k]));
            if (busy_ == kTeam) {
                for (int k = 0; k < kWaits; ++k)
                    for (Member& m : team_) step(m, k);
            } else {
                for (int k = 0; k < kWaits; ++k)
                    for (int i = 0; i < busy_; ++i) step(team_[i], k);
            }
            for (int k = 0; k < busy_; ++k) {
                Member& m = team_[k];
                m.event += kWaits;
                if (m.from.cycle < job_.cycles) continue;
                --users_[m.table];
                if (!take(m)) m = team_[--busy_], --k;
            }
            if (round % kPollWaveform == 0 && block_.stop->load(std::memory_order_relaxed)) return;
        }
    }

private:
    struct Member {
        Instant from;  // where the search for the next arrival begins
        int table;
        Mode mode;
        Output<sink> output;
        Pair<uint32_t> key;
        uint32_t event;
        Waits waits;
    };

    MARS_INLINE void step(Member& m, int k) {
        const WaveformTable<Index>& table = tables_[m.table];
        const double sum = table.energy(m.from.x) + m.waits.energy[k];
        const int64_t over = sum >= table.total;
        const double energy = sum - table.none[over];
        const double x = table.position(energy < table.top ? energy : table.top);
        const int64_t turns = m.waits.whole[k] + over;
        const double least[2] = {m.from.x, 0.0};  // rounding must not turn time back within a period
        const double held = least[turns != 0];
        const Instant hit = {m.from.cycle + turns, x > held ? x : held};
        const bool seen = m.mode(hit, m.from);
        // inside the exposure: 0 <= cycle < cycles, one unsigned comparison
        if (!(seen & (static_cast<uint64_t>(hit.cycle) < static_cast<uint64_t>(job_.cycles)))) return;
        const int32_t bin = static_cast<int32_t>(hit.x * bins_per_part_);
        const double phase = hit.x * periods_per_part_;
        m.output.write(static_cast<int32_t>(hit.cycle), phase < kLastPhase ? phase : kLastPhase,
                       bin < job_.bins ? bin : job_.bins - 1);
    }

    double total(const Member& m) const { return tables_[m.table].total; }

    // Gives a member the next item with any light, or says that there is none left.
    MARS_NOINLINE bool take(Member& m) {
        for (; pixel_ < block_.pixels; ++pixel_, realization_ = 0) {
            const int64_t pixel = block_.first_pixel + pixel_;
            if (realization_ == 0) prepare(pixel);
            while (realization_ < block_.realizations) {
                const int64_t r = block_.first_realization + realization_;
                const int64_t place = pixel_ * block_.realizations + realization_++;
                m.output.open(block_, r * job_.pixels + pixel);
                const WaveformTable<Index>& table = tables_[latest_];
                if (!table.lit()) continue;
                m.from = {0, 0.0};
                if (block_.start_cycle) {
                    const double x = block_.start_phase[place] * table.parts;
                    m.from = {block_.start_cycle[place], x < table.end ? x : table.end};
                }
                m.mode = mode_;
                m.key = stream_key(job_.seed, job_.first_realization + static_cast<uint32_t>(r),
                                   job_.pixel_index[pixel]);
                m.event = 0;
                m.table = latest_;
                ++users_[latest_];
                return true;
            }
        }
        return false;
    }

    // The table of the next pixel, in a place that no member uses.
    void prepare(int64_t pixel) {
        latest_ = 0;
        while (users_[latest_] > 0) ++latest_;
        tables_[latest_].prepare(job_.waveform + pixel * job_.samples, job_.samples, job_.background[pixel]);
    }

    static constexpr double kLastPhase = 0x1.fffffffffffffp-1;

    const WaveformBlock& block_;
    const Job& job_;
    const Mode mode_;  // before the first arrival
    const double bins_per_part_, periods_per_part_;
    int64_t pixel_ = 0, realization_ = 0;  // the next item
    int latest_ = 0, users_[kTeam] = {};  // the latest pixel's table; members that use each one
    WaveformTable<Index> tables_[kTeam];
    Member team_[kTeam];  // the first `busy_` have work
    int busy_ = 0;
};

template <class Mode, Sink sink>
void run_indices(const WaveformBlock& block) {
    if (block.job->samples < 65536) return WaveformRunner<Mode, sink, uint16_t>(block).run();
    return WaveformRunner<Mode, sink, uint32_t>(block).run();
}

template <class Mode>
void run_mode(const WaveformBlock& block) {
    switch (block.sink) {
        case Sink::kCounts: return run_indices<Mode, Sink::kCounts>(block);
        case Sink::kHistogram16: return run_indices<Mode, Sink::kHistogram16>(block);
        case Sink::kHistogram32: return run_indices<Mode, Sink::kHistogram32>(block);
        case Sink::kTimestamps: return run_indices<Mode, Sink::kTimestamps>(block);
    }
}

}  // namespace
}  // namespace MARS_LEVEL

void MARS_JOIN(waveform_kernel_, MARS_LEVEL)(const WaveformBlock& block) {
    switch (block.job->mode) {
        case DetectorMode::kNonparalyzable: return run_mode<FreeRunning>(block);
        case DetectorMode::kParalyzable: return run_mode<ParalyzableMode>(block);
        case DetectorMode::kSynchronous: return run_mode<SynchronousMode>(block);
        case DetectorMode::kGated: return run_mode<GatedMode>(block);
    }
}

}  // namespace mars
