// What kernels take from the standard library, where there is none. NVRTC, which compiles the kernels for CUDA, has
// no headers: there the names of std are these, on a GPU's own functions, of which those of one operation (square
// roots, whole numbers) are exact by IEEE 754. Elsewhere this is the standard library itself.
#pragma once
#include "base/integers.h"
#if !defined(__CUDACC_RTC__)
#include <algorithm>
#include <cmath>
#include <cstring>
#else
#define HUGE_VAL __longlong_as_double(0x7ff0000000000000ll)

namespace std {

template <class T>
const T& max(const T& a, const T& b) {
    return a < b ? b : a;
}
template <class T>
const T& min(const T& a, const T& b) {
    return b < a ? b : a;
}
template <class T>
const T& clamp(const T& x, const T& low, const T& high) {
    return x < low ? low : high < x ? high : x;
}
template <class T>
void swap(T& a, T& b) {
    const T kept = a;
    a = b;
    b = kept;
}
template <class T>
void fill(T* begin, T* end, T value) {
    for (; begin != end; ++begin) *begin = value;
}
// The first that is above x, of ascending numbers.
template <class T>
const T* upper_bound(const T* begin, const T* end, const T& x) {
    while (begin != end) {
        const T* const middle = begin + (end - begin) / 2;
        if (x < *middle)
            end = middle;
        else
            begin = middle + 1;
    }
    return begin;
}

inline double floor(double x) { return ::floor(x); }
inline double ceil(double x) { return ::ceil(x); }
inline double nearbyint(double x) { return ::rint(x); }
inline double sqrt(double x) { return ::sqrt(x); }
inline double fabs(double x) { return ::fabs(x); }
inline double ldexp(double x, int n) { return ::ldexp(x, n); }
inline double erfc(double x) { return ::erfc(x); }

}  // namespace std
#endif

// A function of its own on a GPU, where all that is called once is taken into the caller otherwise, for minutes of
// compiling.
#if defined(__CUDACC_RTC__)
#define MARS_APART __noinline__
#else
#define MARS_APART
#endif

namespace mars {

inline uint64_t double_bits(double x) {
#if defined(__CUDACC_RTC__)
    return static_cast<uint64_t>(__double_as_longlong(x));
#else
    uint64_t u;
    std::memcpy(&u, &x, sizeof u);
    return u;
#endif
}
inline double bits_double(uint64_t u) {
#if defined(__CUDACC_RTC__)
    return __longlong_as_double(static_cast<long long>(u));
#else
    double x;
    std::memcpy(&x, &u, sizeof x);
    return x;
#endif
}

}  // namespace mars
