// Counts packed for storage: which elements of an array are not zero, and what they hold. Format: docs/generate.md.
//
// Registrations of a nearly constant rate leave geometric gaps between the elements that are not zero, for which Rice
// codes are the best code of whole bits (S. W. Golomb, IEEE Trans. Inf. Theory 12, 399 (1966); R. F. Rice, JPL
// Publication 79-22). The parameter follows a running mean, so nothing has to be stored for it, and the code moves from
// background to pulse and from pixel to pixel by itself.
#include <algorithm>
#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <vector>

#include "python/bindings.h"

#if defined(__SSE2__)
#include <emmintrin.h>
#endif
#if defined(__GNUC__) && defined(__x86_64__)
#define MARS_WIDE __attribute__((target("avx512f,avx512bw,avx512vl")))
#include <immintrin.h>
#endif

namespace mars {
namespace {

constexpr int kEscape = 24;  // a quotient of this many zeros or more: the value follows in 32 plain bits
constexpr size_t kHeader = 16, kPadding = 8;
constexpr size_t kMostBytes = 14;   // of one element: two escapes
constexpr size_t kKept = 16 << 20;  // bytes that a thread keeps between calls

void store64(uint8_t* to, uint64_t value) {
    for (int k = 0; k < 8; ++k) to[k] = static_cast<uint8_t>(value >> (8 * k));
}

uint64_t load64(const uint8_t* from) {
    uint64_t value = 0;
    for (int k = 0; k < 8; ++k) value |= static_cast<uint64_t>(from[k]) << (8 * k);
    return value;
}

int log2_of(uint64_t x) {  // floor, x is not 0
#if defined(__GNUC__)
    return 63 - __builtin_clzll(x);
#else
    int n = 0;
    while (x >>= 1) ++n;
    return n;
#endif
}

int trailing_zeros(uint64_t x) {  // x is not 0
#if defined(__GNUC__)
    return __builtin_ctzll(x);
#else
    int n = 0;
    for (; !(x & 1u); x >>= 1) ++n;
    return n;
#endif
}

// The parameter of a Rice code for numbers of about the running mean: floor(log2(mean)), 0 below a mean of 2, which is
// the best one for geometric numbers within a few per cent of the mean. Memory is the number of values, as a power of
// two, over which the mean runs.
template <int Memory>
struct Adaptive {
    uint64_t sum = 0;  // mean times 2^Memory, below 2^(32 + Memory)
    int parameter() const { return log2_of(sum >> Memory | 1); }
    void see(uint32_t value) { sum += value - (sum >> Memory); }
};
using Gaps = Adaptive<4>;
using Counts = Adaptive<1>;

struct Code {
    uint64_t bits;
    int width;  // at most 56
};

// Quotient in zeros, a one, then the k low bits.
Code rice(uint32_t value, int k) {
    const uint32_t quotient = value >> k;
    if (quotient >= kEscape) return {static_cast<uint64_t>(value) << kEscape, kEscape + 32};
    const uint64_t rest = value & ((uint64_t{1} << k) - 1);
    return {(rest << 1 | 1) << quotient, static_cast<int>(quotient) + 1 + k};
}

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

struct BitReader {
    const uint8_t *at, *end;  // readable to end + kPadding
    int used = 0;             // bits of *at

    uint64_t peek() const {
        return load64(at) >> used;  // 57 bits at least
    }
    void skip(int width) {
        used += width;
        at += used >> 3;
        used &= 7;
        if (at > end) throw nb::value_error("packed counts end too early");
    }
    uint32_t rice(int k) {
        const uint64_t word = peek();
        const int quotient = trailing_zeros(word | uint64_t{1} << kEscape);
        if (quotient >= kEscape) {
            skip(kEscape + 32);
            return static_cast<uint32_t>(word >> kEscape);
        }
        skip(quotient + 1 + k);
        const uint64_t rest = (word >> (quotient + 1)) & ((uint64_t{1} << k) - 1);
        return static_cast<uint32_t>(static_cast<uint64_t>(quotient) << k | rest);
    }
};

// Whether 32 bytes are zero.
bool all_zero(const void* from) {
#if defined(__SSE2__)
    const __m128i* const at = static_cast<const __m128i*>(from);
    const __m128i any = _mm_or_si128(_mm_loadu_si128(at), _mm_loadu_si128(at + 1));
    return _mm_movemask_epi8(_mm_cmpeq_epi8(any, _mm_setzero_si128())) == 0xffff;
#else
    uint64_t words[4];
    std::memcpy(words, from, sizeof words);
    return (words[0] | words[1] | words[2] | words[3]) == 0;
#endif
}

// Positions, from `values`, of the elements that are not zero, into `where`; their number. Without branches where there
// are any: at a registration in every third bin none could be predicted.
template <class Count>
size_t find_nonzero(const Count* values, size_t size, uint32_t* where) {
    constexpr size_t kGroup = 32 / sizeof(Count);
    size_t found = 0, i = 0;
    for (; i + kGroup <= size; i += kGroup) {
        if (all_zero(values + i)) continue;
        for (size_t k = i; k < i + kGroup; ++k) {
            where[found] = static_cast<uint32_t>(k);
            found += values[k] != 0;
        }
    }
    for (; i < size; ++i) {
        where[found] = static_cast<uint32_t>(i);
        found += values[i] != 0;
    }
    return found;
}

#if defined(MARS_WIDE)
// The same, 16 elements at a time.
MARS_WIDE uint32_t mask_of(const uint16_t* at) {
    const __m256i some = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(at));
    return _mm256_test_epi16_mask(some, some);
}
MARS_WIDE uint32_t mask_of(const uint32_t* at) {
    const __m512i some = _mm512_loadu_si512(at);
    return _mm512_test_epi32_mask(some, some);
}

template <class Count>
MARS_WIDE size_t find_nonzero_wide(const Count* values, size_t size, uint32_t* where) {
    const __m512i lanes = _mm512_set_epi32(15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0);
    size_t found = 0, i = 0;
    for (; i + 16 <= size; i += 16) {
        const uint32_t mask = mask_of(values + i);
        const __m512i place = _mm512_add_epi32(lanes, _mm512_set1_epi32(static_cast<int>(i)));
        _mm512_storeu_si512(where + found, _mm512_maskz_compress_epi32(static_cast<__mmask16>(mask), place));
        found += static_cast<size_t>(__builtin_popcount(mask));
    }
    for (; i < size; ++i) {
        where[found] = static_cast<uint32_t>(i);
        found += values[i] != 0;
    }
    return found;
}
#endif

// The fastest of them that this processor has; all give the same.
template <class Count>
auto finder() -> size_t (*)(const Count*, size_t, uint32_t*) {
#if defined(MARS_WIDE)
    if (__builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl")) return &find_nonzero_wide<Count>;
#endif
    return &find_nonzero<Count>;
}

template <class Count>
nb::bytes pack(Vector<const Count> counts) {
    const size_t size = counts.shape(0);
    if (size > UINT32_MAX) throw nb::value_error("a chunk must have fewer than 2**32 counts");
    const Count* const values = counts.data();
    static thread_local std::vector<uint8_t> out;  // kept: fresh pages would cost as much as the packing
    size_t used = kHeader;
    {
        nb::gil_scoped_release release;
        constexpr size_t kBlock = 4096;
        uint32_t where[kBlock + 16];
        static const auto find = finder<Count>();
        Gaps gaps;
        Counts above;
        uint64_t events = 0;
        size_t next = 0;  // the first element not yet told of
        BitWriter bits{nullptr};
        if (out.size() > kKept) std::vector<uint8_t>().swap(out);
        out.resize(std::max(out.size(), kHeader + size * sizeof(Count) / 4 + kBlock * kMostBytes + kPadding));
        for (size_t first = 0; first < size; first += kBlock) {
            if (out.size() < used + kBlock * kMostBytes + kPadding)
                out.resize(out.size() + out.size() / 2 + kBlock * kMostBytes);
            bits.at = out.data() + used;
            const size_t found = find(values + first, std::min(kBlock, size - first), where);
            for (size_t k = 0; k < found; ++k) {
                const size_t i = first + where[k];
                const uint32_t gap = static_cast<uint32_t>(i - next), more = static_cast<uint32_t>(values[i]) - 1;
                const Code one = rice(gap, gaps.parameter()), two = rice(more, above.parameter());
                gaps.see(gap);
                above.see(more);
                next = i + 1;
                if (one.width + two.width <= 56) {
                    bits.put({two.bits << one.width | one.bits, one.width + two.width});
                } else {
                    bits.put(one);
                    bits.put(two);
                }
            }
            events += found;
            used = static_cast<size_t>(bits.at - out.data());
        }
        used += bits.held > 0;
        store64(out.data(), size);
        store64(out.data() + 8, events);
    }
    return nb::bytes(out.data(), used);
}

// A padded copy of packed counts, with the two numbers of its header.
struct Packed {
    std::vector<uint8_t> data;
    uint64_t size = 0, events = 0;

    explicit Packed(const Vector<const uint8_t>& packed) {
        const size_t length = packed.shape(0);
        if (length < kHeader) throw nb::value_error("packed counts are shorter than their header");
        data.resize(length + kPadding);
        std::memcpy(data.data(), packed.data(), length);
        size = load64(data.data());
        events = load64(data.data() + 8);
        if (size > UINT32_MAX || events > size || events > 4 * (length - kHeader))
            throw nb::value_error("packed counts have a damaged header");
    }

    template <class Found>
    void for_each(const Found& found) const {
        BitReader bits{data.data() + kHeader, data.data() + data.size() - kPadding};
        Gaps gaps;
        Counts above;
        uint64_t next = 0;
        for (uint64_t k = 0; k < events; ++k) {
            const uint32_t gap = bits.rice(gaps.parameter());
            gaps.see(gap);
            const uint32_t more = bits.rice(above.parameter());
            above.see(more);
            next += gap;
            if (next >= size) throw nb::value_error("packed counts run over their end");
            found(k, next, more);
            ++next;
        }
    }
};

template <class Count>
void unpack(Vector<const uint8_t> packed, Vector<Count> out) {
    nb::gil_scoped_release release;
    const Packed source(packed);
    if (source.size != out.shape(0)) throw nb::value_error("packed counts are of another size than their chunk");
    Count* const to = out.data();
    std::memset(to, 0, source.size * sizeof(Count));
    source.for_each([&](uint64_t, uint64_t position, uint32_t more) {
        const Count count = static_cast<Count>(more + 1);
        if (count != static_cast<uint64_t>(more) + 1) throw nb::value_error("packed counts exceed their type");
        to[position] = count;
    });
}

uint64_t events_of(Vector<const uint8_t> packed) { return Packed(packed).events; }

void unpack_events(Vector<const uint8_t> packed, Vector<int64_t> position, Vector<uint32_t> count) {
    nb::gil_scoped_release release;
    const Packed source(packed);
    if (position.shape(0) != source.events || count.shape(0) != source.events)
        throw nb::value_error("position and count must have one element per event");
    int64_t* const where = position.data();
    uint32_t* const number = count.data();
    source.for_each([&](uint64_t k, uint64_t at, uint32_t more) {
        where[k] = static_cast<int64_t>(at);
        number[k] = more + 1;
    });
}

}  // namespace

void bind_packing(nb::module_& module) {
    module.def("pack_counts", &pack<uint16_t>, nb::arg("counts").noconvert(), "Packed counts (n,).");
    module.def("pack_counts", &pack<uint32_t>, nb::arg("counts").noconvert());
    module.def("unpack_counts", &unpack<uint16_t>, nb::arg("packed"), nb::arg("out").noconvert(),
               "Fill `out` (n,) with what `pack_counts` packed.");
    module.def("unpack_counts", &unpack<uint32_t>, nb::arg("packed"), nb::arg("out").noconvert());
    module.def("packed_events", &events_of, nb::arg("packed"), "Elements that are not zero.");
    module.def("unpack_events", &unpack_events, nb::arg("packed"), nb::arg("position").noconvert(),
               nb::arg("count").noconvert(), "Fill position and count (events,) of the elements that are not zero.");
}

}  // namespace mars
