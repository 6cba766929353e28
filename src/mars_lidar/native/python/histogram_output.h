// What the engines that fill histograms check and report alike.
#pragma once
#include <limits>
#include <stdexcept>
#include <string>

#include "python/bindings.h"

namespace mars {

template <class Count>
void check_histogram(const Job& job, const Matrix<Count>& out) {
    if (static_cast<int64_t>(out.shape(0)) != job.items() || static_cast<int64_t>(out.shape(1)) != job.bins)
        throw nb::value_error("out must be (realizations * pixels, bins)");
}

// Called where a bin would hold more than Count can.
template <class Count>
[[noreturn]] void throw_full() {
    throw std::overflow_error("a histogram bin exceeds " + std::to_string(std::numeric_limits<Count>::max()) +
                              " counts: use fewer cycles, less flux" +
                              (sizeof(Count) < 4 ? ", or an output of uint32" : ""));
}

}  // namespace mars
