// The numbers by which the exact engine's rare draws are told apart from each other. Arrivals of the background and the
// first return are drawn from the item's stream of words (numbers/word_stream.h); every other draw is a function of the
// item's key and two counter words (numbers/random.h): the number of the registration, and one of these.
#pragma once
#include "base/integers.h"

namespace mars {

constexpr uint32_t kStageArrivalFine = 1;  // fresh fractions for long waits of the background and the first return
constexpr uint32_t kStageStart = 2;        // arrivals before a stationary exposure: waits and components; + 1: phases
constexpr uint32_t kStageJitter = 4;       // first word of the counter: half the number; + 1: tails
constexpr uint32_t kStageRecovery = 6;     // what of its sensitivity an arrival asks of the pixel; + 1: fine fractions
constexpr uint32_t kStageReturns = 16;     // + 2 k: returns 2 k + 1 and 2 k + 2; + 2 k + 1: their fractions
constexpr uint32_t kStageTails = 64;       // + k: place of an arrival in the tails of return k
constexpr uint32_t kStageTraps = 0x40000000;  // afterpulses, by the number of the avalanche that leaves carriers (+ k)

}  // namespace mars
