// The vector levels that this build has, widest first, and whether the processor runs them: MARS_EACH_LEVEL(each)
// expands each(level, runs).
#pragma once

#if defined(MARS_HAS_avx512)
#define MARS_LEVEL_OF_512(each)                                                              \
    each(avx512, (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && \
                  __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl")))
#else
#define MARS_LEVEL_OF_512(each)
#endif
#if defined(MARS_HAS_avx2)
#define MARS_LEVEL_OF_256(each) each(avx2, __builtin_cpu_supports("avx2"))
#else
#define MARS_LEVEL_OF_256(each)
#endif
#if defined(MARS_HAS_vector128)
#define MARS_LEVEL_OF_128(each) each(vector128, true)
#else
#define MARS_LEVEL_OF_128(each)
#endif
#define MARS_EACH_LEVEL(each) MARS_LEVEL_OF_512(each) MARS_LEVEL_OF_256(each) MARS_LEVEL_OF_128(each) each(scalar, true)
