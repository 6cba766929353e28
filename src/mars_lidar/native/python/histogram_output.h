// What the bindings of the engines that fill histograms check alike.
#pragma once
#include "python/bindings.h"

namespace mars {

template <class Count>
void check_histogram(const Job& job, const Matrix<Count>& out) {
    if (static_cast<int64_t>(out.shape(0)) != job.items() || static_cast<int64_t>(out.shape(1)) != job.bins)
        throw nb::value_error("out must be (realizations * pixels, bins)");
}

}  // namespace mars
