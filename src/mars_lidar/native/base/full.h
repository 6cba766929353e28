// What is said where a histogram's bin would hold more than its type can.
#pragma once
#include <limits>
#include <stdexcept>
#include <string>

namespace mars {

// The message says what helps; Python raises it as OverflowError.
template <class Count>
[[noreturn]] void throw_full() {
    throw std::overflow_error("a histogram bin exceeds " + std::to_string(std::numeric_limits<Count>::max()) +
                              " counts: use fewer cycles, less flux" +
                              (sizeof(Count) < 4 ? ", or an output of uint32" : ""));
}

}  // namespace mars
