// Sums over bins, and the largest.
#pragma once
#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>

// What is summed side by side must be laid out before compilers look for vectors.
#if defined(_MSC_VER) && !defined(__clang__)
#define MARS_SIDE_BY_SIDE
#else
#define MARS_SIDE_BY_SIDE _Pragma("GCC unroll 8")
#endif

namespace mars {

// Sums of of(j), an array of `number`, over j < n: eight sums side by side, which need not wait for each other.
template <size_t number, class Of>
std::array<double, number> sums_of(int64_t n, const Of& of) {
    constexpr int64_t side = 8;
    double part[number][side] = {};
    std::array<double, number> out{};
    int64_t j = 0;
    for (; j + side <= n; j += side) MARS_SIDE_BY_SIDE
    for (int64_t k = 0; k < side; ++k) {
        const std::array<double, number> each = of(j + k);
        MARS_SIDE_BY_SIDE
        for (size_t i = 0; i < number; ++i) part[i][k] += each[i];
    }
    for (; j < n; ++j) {
        const std::array<double, number> each = of(j);
        for (size_t i = 0; i < number; ++i) part[i][0] += each[i];
    }
    for (size_t i = 0; i < number; ++i)
        for (int64_t k = 0; k < side; ++k) out[i] += part[i][k];
    return out;
}

// The largest of n numbers, by eight maxima side by side.
inline double largest_of(const double* x, int64_t n) {
    constexpr int64_t side = 8;
    double part[side];
    for (double& each : part) each = x[0];
    int64_t j = 0;
    for (; j + side <= n; j += side) MARS_SIDE_BY_SIDE
    for (int64_t k = 0; k < side; ++k) part[k] = part[k] < x[j + k] ? x[j + k] : part[k];
    for (; j < n; ++j) part[0] = std::max(part[0], x[j]);
    return *std::max_element(part, part + side);
}

}  // namespace mars
