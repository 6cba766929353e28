// Counts packed for storage: which elements of an array are not zero, and what they hold. Format: docs/generate.md.
//
// Registrations of a nearly constant rate leave geometric gaps between the elements that are not zero: gaps, and counts less
// one, are Rice codes (storage/rice.h), one after the other, behind a header of two numbers.
#pragma once
#include <algorithm>
#include <cstring>
#include <stdexcept>
#include <type_traits>
#include <utility>
#include <vector>

#include "lanes/nonzero.h"
#include "storage/rice.h"

namespace mars {

constexpr size_t kHeader = 16;      // bytes: elements, and those that are not zero, as little-endian uint64
constexpr size_t kMostBytes = 14;   // of one element: two escapes
constexpr size_t kKept = 16 << 20;  // bytes that a thread keeps between calls

// Packs `size` counts into `out`, which is reused from call to call. Returns the bytes used.
template <class Count>
size_t pack_counts(const Count* values, size_t size, std::vector<uint8_t>& out) {
    // elements that are looked through at a time: their positions stay in the first cache
    constexpr size_t kBlock = 4096;
    size_t used = kHeader;
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
    return used;
}

// A padded copy of packed counts, with the two numbers of its header.
struct Packed {
    std::vector<uint8_t> data;
    uint64_t size = 0, events = 0;

    Packed(const uint8_t* packed, size_t length) {
        if (length < kHeader) throw std::invalid_argument("packed counts are shorter than their header");
        data.resize(length + kPadding);
        std::memcpy(data.data(), packed, length);
        size = load64(data.data());
        events = load64(data.data() + 8);
        if (size > UINT32_MAX || events > size || events > 4 * (length - kHeader))
            throw std::invalid_argument("packed counts have a damaged header");
    }

    // Calls found(k, position, count - 1) for the elements that are not zero, in order.
    template <class Found>
    void for_each(const Found& found) const;
};

// Reads packed counts element by element.
class Unpacker {
    BitReader bits_;
    Gaps gaps_;
    Counts above_;
    uint64_t next_ = 0, size_;

 public:
    explicit Unpacker(const Packed& source)
        : bits_{source.data.data() + kHeader, source.data.data() + source.data.size() - kPadding}, size_(source.size) {}

    // Position and count - 1 of the next element that is not zero.
    MARS_INLINE std::pair<uint64_t, uint32_t> next() {
        const auto [gap, more] = bits_.rice_pair(gaps_.parameter(), above_.parameter());
        gaps_.see(gap);
        above_.see(more);
        const uint64_t position = next_ + gap;
        if (position >= size_) throw std::invalid_argument("packed counts run over their end");
        next_ = position + 1;
        return {position, more};
    }
};

template <class Found>
void Packed::for_each(const Found& found) const {
    Unpacker from(*this);
    for (uint64_t k = 0; k < events; ++k) {
        const auto [position, more] = from.next();
        found(k, position, more);
    }
}

// One more than `more` as a Count; std::invalid_argument where an integer type does not hold it.
template <class Count>
MARS_INLINE Count count_of(uint32_t more) {
    const Count count = static_cast<Count>(static_cast<uint64_t>(more) + 1);
    if (std::is_integral_v<Count> && static_cast<uint64_t>(count) != static_cast<uint64_t>(more) + 1)
        throw std::invalid_argument("packed counts exceed their type");
    return count;
}

// Fills `out` (source.size) with what was packed.
template <class Count>
void unpack_counts(const Packed& source, Count* out) {
    std::memset(out, 0, source.size * sizeof(Count));
    source.for_each([&](uint64_t, uint64_t position, uint32_t more) { out[position] = count_of<Count>(more); });
}

}  // namespace mars
