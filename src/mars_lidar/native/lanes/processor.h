// What the processor that this runs on can do.
#pragma once

#if defined(MARS_LEVEL_BY_NAME)
#include <cstdlib>
#include <cstring>
#endif

#if defined(_MSC_VER) && defined(__x86_64__)  // clang-cl: Windows has no library for __builtin_cpu_supports
#include <intrin.h>
extern "C" __declspec(dllimport) int __stdcall IsProcessorFeaturePresent(unsigned long feature);
#endif

namespace mars {

#if defined(_MSC_VER) && defined(__x86_64__)
inline bool has_avx2() { return IsProcessorFeaturePresent(40) != 0; }  // PF_AVX2_INSTRUCTIONS_AVAILABLE
inline bool has_avx512() {                                             // F by PF_AVX512F_INSTRUCTIONS_AVAILABLE
    int leaf[4] = {};
    __cpuidex(leaf, 7, 0);
    const unsigned needs = 1u << 17 | 1u << 30 | 1u << 31;  // DQ, BW, VL
    return IsProcessorFeaturePresent(41) != 0 && (static_cast<unsigned>(leaf[1]) & needs) == needs;
}
#elif defined(__x86_64__)
inline bool has_avx2() { return __builtin_cpu_supports("avx2"); }
inline bool has_avx512() {
    return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
           __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
}
#endif

// Builds for checks (CMake's MARS_SANITIZE) run only the level that $MARS_LIDAR_LEVEL names, if it names one.
#if defined(MARS_LEVEL_BY_NAME)
inline bool may_run(const char* level) {
    const char* const asked = std::getenv("MARS_LIDAR_LEVEL");
    return !asked || std::strcmp(asked, level) == 0;
}
#else
constexpr bool may_run(const char*) { return true; }
#endif

}  // namespace mars
