// What the estimators of a histogram share.
#pragma once
#include <optional>

#include <nanobind/stl/optional.h>

#include "python/bindings.h"
#include "reconstruct/histogram_record.h"

namespace mars {

// What is to be said of a pixel; `mars_lidar.reconstruct.Flags`.
enum Flag : uint8_t { kEmpty = 1, kNoSignal = 2, kSaturated = 4, kUnconverged = 8 };

struct ReconstructionJob {
    int starts = 1;           // delays to begin at
    double least_gain = 0.0;  // twice the gain of the log likelihood below which a signal counts as not seen
    bool less_bias = false;   // take off the first-order bias of the maximum
};

}  // namespace mars
