// Laws of an exposure's number of registrations: one word of the pixel's own random stream makes one count.
#pragma once
#include "laws/matched_law.h"
#include "numbers/event_stream.h"

namespace mars {

constexpr uint64_t kCountDomain = 0x436f756e74730000u;  // "Counts": not another engine's numbers at one seed
constexpr double kMostCounts = 9007199254740992.0;      // 2^53

// The normal law rounded to integers, what lies below 0 put at 0.
struct RoundedNormal {
    double mean, deviation;
    int64_t operator()(const EventStream& stream) const {
        const double x = std::nearbyint(mean + deviation * normal_quantile(open_uniform(stream.word(0, 0))));
        return static_cast<int64_t>(std::clamp(x, 0.0, kMostCounts));
    }
};

// The law with four given cumulants.
struct Matched {
    MatchedLaw law;
    int64_t operator()(const EventStream& stream) const { return law.draw(open_uniform(stream.word(0, 0))); }
};

// A tabulated distribution function: the first count whose P(N <= n) exceeds the uniform number.
struct Tabulated {
    const double *begin, *end;
    int64_t first;
    int64_t operator()(const EventStream& stream) const {
        const double u = open_uniform(stream.word(0, 0));
        return first + std::min<int64_t>(std::upper_bound(begin, end, u) - begin, end - begin - 1);
    }
};

}  // namespace mars
