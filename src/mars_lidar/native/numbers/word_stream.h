// The random words of one item of the exact engine, one after the other: sfc32, the small fast counting generator of
// C. Doty-Humphrey, seeded by 64 bits as in his PractRand (0.94), at a third of the instructions of Threefry.
//
// The seed is the item's key (numbers/random.h), which no other item shares. Streams of different keys never meet
// within 2^32 words: a round maps states one to one and counts, so that two streams are at equal states only after
// equal numbers of rounds, and then only if they began as one. docs/results/randomness.md has the batteries that the
// words pass as the engine takes them.
#pragma once
#include "numbers/random.h"

namespace mars {
inline namespace MARS_LEVEL {

// `U` holds the words of all lanes, or those of one stream.
template <class U>
struct WordStream {
    U a, b, c, counter;

    MARS_INLINE U next() {
        const U word = a + b + counter;
        counter = counter + 1u;
        a = b ^ (b >> 9);
        b = c + (c << 3);
        c = rotate<21>(c) + word;
        return word;
    }
};

MARS_INLINE WordStream<uint32_t> word_stream(const Pair<uint32_t>& key) {
    WordStream<uint32_t> stream = {0u, key.first, key.second, 1u};
    for (int k = 0; k < 12; ++k) stream.next();
    return stream;
}

}  // namespace MARS_LEVEL
}  // namespace mars
