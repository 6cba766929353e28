// What is to be said of a pixel's estimates: `mars_lidar.reconstruct.Flags`.
#pragma once
#include <cstdint>

namespace mars {

enum Flag : uint8_t { kEmpty = 1, kNoSignal = 2, kSaturated = 4, kUnconverged = 8, kMoreReturns = 16, kFilled = 32 };

}  // namespace mars
