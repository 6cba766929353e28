// Rows of lanes turned into columns: what lanes found one after the other, for each of them by itself.
#pragma once
#include "lanes/lanes.h"

namespace mars {
inline namespace MARS_LEVEL {

#if MARS_LANES > 1
// Four lanes.
typedef float FourFloats __attribute__((vector_size(16)));
typedef int32_t FourInts __attribute__((vector_size(16)));
typedef double FourDoubles __attribute__((vector_size(32)));

// Four numbers of each of four rows of lanes, from `rows` on, by columns.
template <class Four, class Scalar>
MARS_INLINE void columns_of_four(const Scalar* rows, Four (&columns)[4]) {
    static_assert(sizeof(Scalar) == 4, "numbers of 32 bits");
#if defined(MARS_X86)
    __m128 row[4];
    for (int k = 0; k < 4; ++k) row[k] = _mm_loadu_ps((const float*)(rows + k * kLanes));
    _MM_TRANSPOSE4_PS(row[0], row[1], row[2], row[3]);
    for (int k = 0; k < 4; ++k) columns[k] = (Four)row[k];
#else
    for (int i = 0; i < 4; ++i)
        for (int k = 0; k < 4; ++k) columns[i][k] = rows[k * kLanes + i];
#endif
}
#endif

// Eight numbers of each of eight rows: columns[stride_out * i + k] = rows[stride_in * k + i].
MARS_INLINE void transpose_eight(const uint16_t* rows, int64_t stride_in, uint16_t* columns, int64_t stride_out) {
#if defined(MARS_X86)
    __m128i a[8], b[8];
    for (int k = 0; k < 8; ++k) a[k] = _mm_loadu_si128((const __m128i*)(rows + stride_in * k));
    // pairs of rows four apart side by side, three times: the bits of row and column change places
    for (int k = 0; k < 4; ++k) {
        b[2 * k] = _mm_unpacklo_epi16(a[k], a[k + 4]);
        b[2 * k + 1] = _mm_unpackhi_epi16(a[k], a[k + 4]);
    }
    for (int k = 0; k < 4; ++k) {
        a[2 * k] = _mm_unpacklo_epi16(b[k], b[k + 4]);
        a[2 * k + 1] = _mm_unpackhi_epi16(b[k], b[k + 4]);
    }
    for (int k = 0; k < 4; ++k) {
        b[2 * k] = _mm_unpacklo_epi16(a[k], a[k + 4]);
        b[2 * k + 1] = _mm_unpackhi_epi16(a[k], a[k + 4]);
    }
    for (int k = 0; k < 8; ++k) _mm_storeu_si128((__m128i*)(columns + stride_out * k), b[k]);
#else
    for (int i = 0; i < 8; ++i)
        for (int k = 0; k < 8; ++k) columns[stride_out * i + k] = rows[stride_in * k + i];
#endif
}
MARS_INLINE void transpose_eight(const uint32_t* rows, int64_t stride_in, uint32_t* columns, int64_t stride_out) {
#if defined(MARS_X86)
    for (int i = 0; i < 8; i += 4)
        for (int k = 0; k < 8; k += 4) {
            __m128 row[4];
            for (int r = 0; r < 4; ++r) row[r] = _mm_loadu_ps((const float*)(rows + stride_in * (k + r) + i));
            _MM_TRANSPOSE4_PS(row[0], row[1], row[2], row[3]);
            for (int r = 0; r < 4; ++r) _mm_storeu_ps((float*)(columns + stride_out * (i + r) + k), row[r]);
        }
#else
    for (int i = 0; i < 8; ++i)
        for (int k = 0; k < 8; ++k) columns[stride_out * i + k] = rows[stride_in * k + i];
#endif
}

}  // namespace MARS_LEVEL
}  // namespace mars
