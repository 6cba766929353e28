// words ORDER STREAMS WORDS SEED: the words of words.h to standard output for ever, for PractRand and dieharder.
//
//   c++ -std=c++17 -O3 -march=native -I src/mars_lidar/native -o words tests/randomness/words.cpp
//   ./words pixels 32 24 1 | RNG_test stdin32 -tlmax 64GB
#include "words.h"

#include <cstdio>
#include <cstdlib>

int main(int argc, char** argv) {
    if (argc != 5) {
        std::fprintf(stderr, "usage: words pixels|realizations|seeds STREAMS WORDS SEED\n");
        return 2;
    }
    battery::Words words(argv[1], static_cast<uint32_t>(std::strtoul(argv[2], nullptr, 0)),
                         std::strtoull(argv[3], nullptr, 0), std::strtoull(argv[4], nullptr, 0));
    std::vector<uint32_t> block(1 << 15);
    do {
        for (uint32_t& word : block) word = words.next();
    } while (std::fwrite(block.data(), sizeof(uint32_t), block.size(), stdout) == block.size());
    return 0;
}
