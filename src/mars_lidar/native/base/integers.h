// Integers of fixed width for code that also runs on a GPU. NVRTC, which compiles the kernels for CUDA, has no
// standard library, and so no <cstdint>.
#pragma once
#if defined(__CUDACC_RTC__)
using int32_t = int;
using uint8_t = unsigned char;
using uint16_t = unsigned short;
using uint32_t = unsigned int;
using int64_t = long long;
using uint64_t = unsigned long long;
#define INT32_MAX 2147483647
#else
#include <stdint.h>
#endif
