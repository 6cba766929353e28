// Rice codes whose parameter follows the numbers: of whole bits the best codes for geometric numbers (S. W. Golomb, IEEE Trans.
// Inf. Theory 12, 399 (1966); R. F. Rice, JPL Publication 79-22). The parameter is that of a running mean, so nothing has to
// be stored for it, and the code moves from background to pulse and from pixel to pixel by itself.
#pragma once
#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <utility>

#include "lanes/bits.h"

namespace mars {

constexpr size_t kPadding = 8;  // bytes behind a code that a reader may look at

constexpr int kEscape = 24;  // a quotient of this many zeros or more: the value follows in 32 plain bits
// Little-endian numbers. Compilers make one instruction of these expressions, and of a loop only where they unroll it.
MARS_INLINE void store64(uint8_t* to, uint64_t x) {
    to[0] = static_cast<uint8_t>(x), to[1] = static_cast<uint8_t>(x >> 8), to[2] = static_cast<uint8_t>(x >> 16);
    to[3] = static_cast<uint8_t>(x >> 24), to[4] = static_cast<uint8_t>(x >> 32), to[5] = static_cast<uint8_t>(x >> 40);
    to[6] = static_cast<uint8_t>(x >> 48), to[7] = static_cast<uint8_t>(x >> 56);
}

MARS_INLINE uint64_t load64(const uint8_t* from) {
    const auto byte = [&](int k) { return static_cast<uint64_t>(from[k]) << (8 * k); };
    return byte(0) | byte(1) | byte(2) | byte(3) | byte(4) | byte(5) | byte(6) | byte(7);
}

// The parameter of a Rice code for numbers of about the running mean: floor(log2(mean)), 0 below a mean of 2, which is
// the best one for geometric numbers within a few per cent of the mean. Memory is the number of values, as a power of
// two, over which the mean runs.
template <int Memory>
struct Adaptive {
    uint64_t sum = 0;  // mean times 2^Memory, below 2^(32 + Memory)
    MARS_INLINE int parameter() const { return highest_bit(sum >> Memory | 1); }
    MARS_INLINE void see(uint32_t value) { sum += value - (sum >> Memory); }
};
using Gaps = Adaptive<4>;
using Counts = Adaptive<1>;

// The bits of one code, the lowest first.
struct Code {
    uint64_t bits;
    int width;  // at most 56
};

// Quotient in zeros, a one, then the k low bits.
inline Code rice(uint32_t value, int k) {
    const uint32_t quotient = value >> k;
    if (quotient >= kEscape) return {static_cast<uint64_t>(value) << kEscape, kEscape + 32};
    const uint64_t rest = value & ((uint64_t{1} << k) - 1);
    return {(rest << 1 | 1) << quotient, static_cast<int>(quotient) + 1 + k};
}

// Appends codes to memory that has room; `at` moves on by whole bytes.
struct BitWriter {
    uint8_t* at;
    uint64_t bits = 0;
    int held = 0;  // below 8 between calls

    void put(Code code) {
        bits |= code.bits << held;
        held += code.width;
        store64(at, bits);
        at += held >> 3;
        bits >>= held & ~7;  // held is below 64: 7 + 56 at most
        held &= 7;
    }
};

// Reads codes one after the other; std::invalid_argument where they go on beyond the end.
struct BitReader {
    const uint8_t *at, *end;  // readable to end + kPadding
    int used = 0;             // bits of *at

    MARS_INLINE uint64_t peek() const {
        return load64(at) >> used;  // 57 bits at least
    }
    MARS_INLINE void skip(int width) {
        used += width;
        at += used >> 3;
        used &= 7;
        if (at > end) throw std::invalid_argument("packed counts end too early");
    }
    uint32_t rice(int k) {
        const uint64_t word = peek();
        const int quotient = quotient_of(word);
        if (quotient >= kEscape) {
            skip(kEscape + 32);
            return static_cast<uint32_t>(word >> kEscape);
        }
        skip(quotient + 1 + k);
        return value(word, quotient, k);
    }
    // Two codes, of parameters k and j. Nearly always one word holds both, and reading is a matter of how long each step
    // waits for the one before it.
    MARS_INLINE std::pair<uint32_t, uint32_t> rice_pair(int k, int j) {
        const uint64_t word = peek();
        const int quotient = quotient_of(word), first = quotient + 1 + k;
        const uint64_t rest = word >> first;
        const int another = quotient_of(rest), width = first + another + 1 + j;
        if (quotient >= kEscape || another >= kEscape || width > 57) {
            const uint32_t one = rice(k);
            return {one, rice(j)};
        }
        skip(width);
        return {value(word, quotient, k), value(rest, another, j)};
    }

 private:
    static MARS_INLINE int quotient_of(uint64_t word) { return lowest_bit(word | uint64_t{1} << kEscape); }
    static MARS_INLINE uint32_t value(uint64_t word, int quotient, int k) {
        const uint64_t rest = (word >> (quotient + 1)) & ((uint64_t{1} << k) - 1);
        return static_cast<uint32_t>(static_cast<uint64_t>(quotient) << k | rest);
    }
};
}  // namespace mars
