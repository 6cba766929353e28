// How long before the exposure the life of a warmed-up pixel begins.
#pragma once
#include <algorithm>
#include <cmath>

namespace mars {

// The beginning is uniform on [kSettle, kSettle + spread] before the exposure, in units of what settles in one turn: a dead
// time and a period. With a dead time of many periods and a bright pulse, registrations lock to every k-th period, and
// *which* periods those are is never forgotten: what remains is of the order of (initial error) / spread.
//
// Where the dead time is nearly a whole number of periods a registration's phase drifts through the pulse, by one photon's
// share a turn, and begins anew behind it: rounds of as many turns as the pulse has photons, all about as long, whose place
// is not forgotten for the square of that. There the spread is some ten rounds.
// `memory` is the number of turns for which twilight pulses are remembered (instrument/twilight.h).
constexpr double kSettle = 256.0, kSpread = 64.0;
constexpr double kDrifts = 0.05;           // periods that the dead time is from a whole number of them
constexpr double kPhotonsInSpread = 10.0;  // turns of a round that kSpread will do for

inline double warm_up_periods(double dead_time, double settle, double photons, double uniform, double memory = 0.0) {
    const bool drifts = dead_time >= 0.5 && std::abs(dead_time - std::nearbyint(dead_time)) < kDrifts;
    const double spread = kSpread * (drifts ? std::max(1.0, photons / kPhotonsInSpread) : 1.0);
    return settle * (std::max(kSettle, memory) + spread * uniform);
}

}  // namespace mars
