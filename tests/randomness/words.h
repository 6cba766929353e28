// The random words of the exact engine in the orders in which a simulation takes them, for batteries of tests.
#pragma once
#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <string>
#include <vector>

#include "numbers/word_stream.h"

namespace battery {

// Streams side by side, one word of each in turn, as lanes draw them. After `words` words of each, the next streams.
//
// "pixels": streams of neighbouring pixels; "realizations": of one pixel; "seeds": of one pixel under successive seeds.
class Words {
 public:
    Words(const std::string& neighbours, uint32_t streams, uint64_t words, uint64_t seed)
        : neighbours_(neighbours), words_(words), seed_(seed), streams_(streams), place_(streams) {
        if (neighbours != "pixels" && neighbours != "realizations" && neighbours != "seeds")
            throw std::invalid_argument("the order must be pixels, realizations or seeds, got " + neighbours);
        if (streams == 0 || words == 0) throw std::invalid_argument("streams and words must be positive");
    }

    uint32_t next() {
        if (place_ == streams_.size()) {
            if (drawn_ % words_ == 0) begin();
            ++drawn_;
            place_ = 0;
        }
        return streams_[place_++].next();
    }

 private:
    void begin() {
        for (auto& stream : streams_) {
            const uint32_t pixel = neighbours_ == "pixels" ? static_cast<uint32_t>(number_) : 0u;
            const uint32_t realization =
                neighbours_ == "realizations" ? static_cast<uint32_t>(number_) : static_cast<uint32_t>(number_ >> 32);
            const uint64_t seed = neighbours_ == "seeds" ? seed_ + number_ : seed_;
            stream = mars::word_stream(mars::stream_key(seed, realization, pixel));
            ++number_;
        }
    }

    const std::string neighbours_;
    const uint64_t words_, seed_;
    std::vector<mars::WordStream<uint32_t>> streams_;
    size_t place_;
    uint64_t drawn_ = 0, number_ = 0;  // words of each of these streams; streams so far
};

}  // namespace battery
