// The engine "mars" on a GPU: laws of the counts, one pixel a thread, then histograms, one pixel a block. What is drawn
// is what the processor draws: the same headers, other teams (team.h).
#pragma once
#include "cuda/device_team.h"
#include "laws/count_laws.h"
#include "laws/matched_trust.h"
#include "mars/photon_plan.h"
#include "mars/shape_rounds.h"
#include "mars/table_lookup.h"

namespace mars {
inline namespace MARS_LEVEL {

// Passed to the kernels by value; all pointers are the device's.
struct MarsLawTask {
    TableLookup table;
    const double *signal, *background;  // (pixels) photons per period
    const double* phase;                // (pixels) of the exposure's beginning, as tables have it: [0, 1)
    int64_t* rows;                      // (pixels, 4) to be found; likewise below
    double* weights;                    // (pixels, 4)
    double* cumulants;                  // (pixels, 4)
    double* rate;                       // (pixels) registrations per period
    MatchedLaw* laws;                   // (pixels), or null: other laws
    uint8_t* doubted;                   // (pixels) 1 where the cumulants do not fix the law, or null: not to be told
    uint32_t* found;                    // (2), zeros at first: pixels doubted; pixels of entries that cannot serve
    int64_t pixels, cycles;
};

struct MarsTask {
    ShapeJob shapes;          // of one image of the output
    const MatchedLaw* laws;   // (pixels), or null
    const double* cumulants;  // (pixels, 4): without laws the rounded normal numbers of mean and variance
    const int32_t* exact;     // (pixels) which tabulated law it is in place of that, or -1; null: none has one
    const int64_t *law_first, *law_offsets;  // of the tabulated laws, as in `Tabulated`
    const double* law_cumulative;
    void* out;                  // (realizations, image, bins)
    int64_t runs, parts, deep;  // a run: `deep` realizations of a pixel at most; `parts` of them are a pixel's
    uint32_t* queue;            // 0 at first: the next run
    uint32_t* full;             // 0 at first: 1 where a bin exceeded the output's type
    uint8_t* work;              // work areas in the device's memory, or null: in the blocks'
    int64_t work_bytes;         // of each block
};

MARS_KERNEL mars_laws(const MarsLawTask task) {
    const int64_t p = device_place().thread;
    if (p >= task.pixels) return;
    double k[kCumulants];
    task.table.pixel(task.signal[p], task.background[p], task.phase[p], task.rows + 4 * p, task.weights + 4 * p, k);
    for (int c = 0; c < kCumulants; ++c) task.cumulants[4 * p + c] = k[c];
    task.rate[p] = k[0] / static_cast<double>(task.cycles);
    if (k[0] != k[0]) add_later(task.found + 1, 1u);
    if (!task.laws) return;
    const Cumulants given{k[0], k[1], k[2], k[3]};
    MatchedLaw& law = task.laws[p];
    law.set(given);
    if (!task.doubted) return;
    const bool doubted = !trusted(given, law);
    task.doubted[p] = doubted ? 1 : 0;
    if (doubted) add_later(task.found, 1u);
}

namespace {

// Photons one by one, shared among a block's threads.
class BlockPhotons : public PhotonPlan<BlockTeam> {
 public:
    BlockPhotons(const ShapeJob& job, Alignment<BlockTeam>& alignment, uint32_t* counts, Bump& memory,
                 const BlockTeam& team)
        : PhotonPlan(job, alignment, memory, team), counts_(counts) {
        place_ = memory.take<uint32_t>(kBlock * kBlocks);
        accepted_ = memory.take<uint32_t>(kBlock * kBlocks / 32);
    }

    // One exposure of the pixel, into counters that are 0.
    void draw(int64_t photons, Pair<uint32_t> key) const {
        const int64_t framed = framed_of(photons, key);
        scatter(photons - framed, key);
        place(framed, key);
    }

 private:
    // Words are used in blocks of 64: the first words of 32 events, then their second words.
    static MARS_INLINE Pair<uint32_t> words(int64_t event, uint32_t step, Pair<uint32_t> key) {
        return threefry<13, uint32_t>(static_cast<uint32_t>(event), step, key.first, key.second);
    }
    static MARS_INLINE int64_t number_of(int64_t event, int half) {
        return event / 32 * kBlock + half * 32 + event % 32;
    }

    int64_t framed_of(int64_t photons, Pair<uint32_t> key) const {
        int64_t used = 0;  // words
        return framed_photons(share_, photons, [&](int64_t number) {
            const int64_t first = used;
            used += (number + 31) / 32;
            return team_.total(used - first, [=](int64_t i) {
                const int64_t word = first + i, left = number - 32 * i;
                const Pair<uint32_t> both = words(word / kBlock * 32 + word % 32, kShareStep, key);
                const uint32_t bits = word % kBlock < 32 ? both.first : both.second;
                return static_cast<int64_t>(ones_in(bits & (left < 32 ? (1u << left) - 1 : ~0u)));
            });
        });
    }

    // Photons outside of the frame: of each batch of proposals the first accepted ones that are wanted.
    void scatter(int64_t photons, Pair<uint32_t> key) const {
        const uint32_t n = static_cast<uint32_t>(n_);
        int64_t event = 0;
        for (int64_t left = photons; left > 0;) {
            const int64_t blocks = blocks_for(left), first = event, wanted = left;
            team_.each(2 * blocks, [=](int64_t w) { accepted_[w] = 0; });
            team_.each(32 * blocks, [=](int64_t i) {
                const Pair<uint32_t> both = words(first + i, kProposeStep, key);
                for (int half = 0; half < 2; ++half) {
                    const uint32_t word = half ? both.second : both.first;
                    const Proposals made = proposals(word);
                    const uint32_t bin = made.no ? n : made.told ? static_cast<uint32_t>(made.bin) : decided(word);
                    const int64_t k = number_of(i, half);
                    place_[k] = bin;
                    if (bin < n) set_bit(accepted_ + k / 32, static_cast<uint32_t>(k % 32));
                }
            });
            const int64_t accepted =
                team_.total(2 * blocks, [=](int64_t w) { return static_cast<int64_t>(ones_in(accepted_[w])); });
            team_.each(kBlock * blocks, [=](int64_t k) {
                if (place_[k] == n || (accepted > wanted && before(k) >= wanted)) return;
                team_.increment(counts_ + place_[k]);
            });
            left -= accepted < wanted ? accepted : wanted;
            event += 32 * blocks;
        }
    }

    // Accepted proposals before one.
    int64_t before(int64_t k) const {
        int64_t number = ones_in(accepted_[k / 32] & ((1u << (k % 32)) - 1));
        for (int64_t w = 0; w < k / 32; ++w) number += ones_in(accepted_[w]);
        return number;
    }

    // Photons of the frame.
    void place(int64_t photons, Pair<uint32_t> key) const {
        team_.each((photons + kBlock - 1) / kBlock * 32, [=](int64_t event) {
            const Pair<uint32_t> both = words(event, kFrameStep, key);
            for (int half = 0; half < 2; ++half) {
                if (number_of(event, half) >= photons) continue;
                const uint32_t u = (half ? both.second : both.first) >> 1;
                int64_t low = 0, high = last_;  // the first outcome whose end lies behind u
                while (low < high) {
                    const int64_t middle = (low + high) / 2;
                    if (until_[middle] > u)
                        high = middle;
                    else
                        low = middle + 1;
                }
                const int64_t bin = first_ + low;
                team_.increment(counts_ + (bin < n_ ? bin : bin - n_));
            }
        });
    }

    uint32_t* counts_;    // (bins)
    uint32_t* place_;     // bins of a batch of proposals; n where rejected
    uint32_t* accepted_;  // a bit for each
};

MARS_INLINE int64_t mars_count(const MarsTask& task, int64_t pixel, int64_t turn, uint32_t realization) {
    const ShapeJob& job = task.shapes;
    if (job.counts) return job.counts[turn * job.pixels + pixel];
    const EventStream stream(job.seed, kCountDomain, realization, job.pixel_index[pixel]);
    if (task.exact && task.exact[pixel] >= 0) {
        const int64_t law = task.exact[pixel];
        const Tabulated exact{task.law_cumulative + task.law_offsets[law],
                              task.law_cumulative + task.law_offsets[law + 1], task.law_first[law]};
        return exact(stream);
    }
    if (task.laws) return task.laws[pixel].draw(open_uniform(stream.word(0, 0)));
    const RoundedNormal normal{task.cumulants[4 * pixel], std::sqrt(std::max(task.cumulants[4 * pixel + 1], 0.0))};
    return normal(stream);
}

// What a block works in.
struct MarsBlock {
    MarsBlock(const ShapeJob& job, Bump& memory, const BlockTeam& team)
        : alignment(job, memory, team),
          rounds(job, memory, team),
          photons(job, alignment, rounds.counts, memory, team) {}

    Alignment<BlockTeam> alignment;
    Rounds<BlockTeam> rounds;
    BlockPhotons photons;
};

}  // namespace

template <bool wide>
struct CountOf {
    using Type = uint16_t;
};
template <>
struct CountOf<true> {
    using Type = uint32_t;
};

template <bool wide>
MARS_KERNEL mars_histograms(const MarsTask task) {
    const ShapeJob& job = task.shapes;
    const DevicePlace place = device_place();
    uint8_t* const memory = task.work ? task.work + place.thread / place.lanes * task.work_bytes : block_memory();
    const BlockTeam team(place, memory);
    Bump bump{reinterpret_cast<char*>(memory) + BlockTeam::kBytes};
    MarsBlock block(job, bump, team);
    block.alignment.clear();
    const bool serve = BlockPhotons::serve(job);
    for (;;) {
        const int64_t run = team.agreed([&] { return static_cast<int64_t>(take_turns(task.queue, 1u)); });
        if (run >= task.runs) return;
        const int64_t p = run / task.parts, first = (run - p * task.parts) * task.deep;
        const int64_t last = first + task.deep < job.realizations ? first + task.deep : job.realizations;
        const bool short_way = serve && block.photons.set(p);
        bool formed = false;
        for (int64_t r = first; r < last; ++r) {
            const uint32_t number = job.first_realization + static_cast<uint32_t>(r);
            const Pair<uint32_t> key = stream_key(job.seed ^ kShapeDomain, number, job.pixel_index[p]);
            const int64_t count = team.agreed([&] { return mars_count(task, p, r, number); });
            typename CountOf<wide>::Type* const to =
                static_cast<typename CountOf<wide>::Type*>(task.out) + (r * job.image + job.place[p]) * job.bins;
            bool fits;
            if (short_way && block.photons.pays(count)) {
                block.rounds.clear();
                block.photons.draw(count, key);
                fits = block.rounds.write(to);
            } else {
                if (!formed) {
                    block.alignment.set(p);
                    block.rounds.set(block.alignment.shape);
                    formed = true;
                }
                fits = block.rounds.draw(count, key, to, nullptr);
            }
            if (!fits) add_later(task.full, 1u);
        }
    }
}

}  // namespace MARS_LEVEL
}  // namespace mars
