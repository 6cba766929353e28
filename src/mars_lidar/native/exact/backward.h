// The state of a warmed-up pixel at t = 0, drawn exactly from the arrivals before it.
//
// Photons arrive at the same rate for ever, so those before t = 0 can be drawn backward in time. Where none arrived
// for a dead time, the pixel was armed at the end of that gap whatever happened before: from there the dead time is
// followed forward to t = 0. No equation is solved and no grid is needed; the cost is the number of photons back to
// the last gap, about e^(photons in a dead time), which is why bright pixels take stationary.h. Which of the two
// serves a pixel depends on its flux alone: giving up a search that takes long would favour short ones.
//
// This is perfect simulation at a regeneration (S. Foss, R. Tweedie, "Perfect simulation and backward coupling",
// Stochastic Models 14, 1998).
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <functional>
#include <vector>

#include "exact/registration.h"

namespace mars {

// Whether the search is cheaper than the solver: `least` photons, at most, in the darkest window of a dead time.
inline bool gaps_are_near(double photons, double least, double dead_time) {
    if (least > kGapPhotonsMost) return false;
    double growth = 1.0 + least / 64.0;  // to the power of 64: e^least without libm
    for (int k = 0; k < 6; ++k) growth *= growth;
    return photons * (std::floor(dead_time) + 1.0) * growth < kGapArrivalsMost;
}

// A uniform number on (0, 1) of 64 bits.
inline double unit(const Pair<uint32_t>& words) { return (words.first + (words.second + 0.5) * 0x1p-32) * 0x1p-32; }

// The uniform number that draws a state of stationary.h or mode_start.h.
inline double start_uniform(const Pair<uint32_t>& key) {
    return unit(threefry<13, uint32_t>(0u, kStageStart, key.first, key.second));
}

// Draws residual dead times. `place(choice, words)` turns random words into the phase in [0, 1) of an arrival.
class GapSearch {
 public:
    // Time from t = 0 to re-arming of a pixel that sees `photons` per period; 0 if it is armed.
    template <class Place>
    double residual(double photons, double dead_time, const Pair<uint32_t>& key, const Place& place) {
        arrivals_.clear();
        if (!(photons >= kDarkest)) return 0.0;
        // numbers of arrivals in successive periods are those of a Poisson process on the axis of expected photons
        double clock = 0.0, armed = 0.0;  // `armed`: the earliest arrival looked at; before any, t = 0
        uint32_t event = 0, choice = 0;
        auto next = [&] {
            const Pair<uint32_t> words = threefry<13, uint32_t>(event, kStageStart, key.first, key.second);
            clock += static_cast<double>(exponential(words.first));
            choice = words.second;
        };
        next();
        for (bool found = false; !found;) {
            const double period = std::floor(clock / photons);
            const size_t begin = arrivals_.size();
            do {  // all arrivals of this period: in any order, with independent phases
                const Pair<uint32_t> words = threefry<13, uint32_t>(event, kStageStart + 1, key.first, key.second);
                arrivals_.push_back(place(choice, words) - 1.0 - period);
                ++event;
                next();
            } while (std::floor(clock / photons) == period);
            std::sort(arrivals_.begin() + static_cast<int64_t>(begin), arrivals_.end(), std::greater<double>());
            for (size_t k = begin; k < arrivals_.size(); ++k) {
                if (armed - arrivals_[k] >= dead_time) {
                    arrivals_.resize(k);
                    found = true;
                    break;
                }
                armed = arrivals_[k];
            }
        }
        double until = armed;
        for (size_t k = arrivals_.size(); k-- > 0;)
            if (arrivals_[k] >= until) until = arrivals_[k] + dead_time;
        return std::max(until, 0.0);
    }

 private:
    std::vector<double> arrivals_;  // latest first
};

}  // namespace mars
