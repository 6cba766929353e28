// crush BATTERY ORDER STREAMS WORDS SEED: TestU01's SmallCrush, Crush or BigCrush on the words of words.h, or on their
// bits in reverse (BATTERY with the suffix "-reversed").
//
//   c++ -std=c++17 -O3 -march=native -I src/mars_lidar/native -o crush tests/randomness/crush.cpp
//       -ltestu01 -lprobdist -lmylib -lm
//   ./crush Crush pixels 32 24 1
//
// P. L'Ecuyer, R. Simard, "TestU01: A C library for empirical testing of random number generators", ACM Trans. Math.
// Softw. 33, 22 (2007).
#include "words.h"

#include <cstdio>
#include <cstdlib>

extern "C" {
#include <TestU01.h>
}

namespace {

battery::Words* words = nullptr;
bool reversed = false;

unsigned int next_word() {
    uint32_t word = words->next();
    if (!reversed) return word;
    word = (word >> 16) | (word << 16);
    word = ((word >> 8) & 0x00ff00ffu) | ((word & 0x00ff00ffu) << 8);
    word = ((word >> 4) & 0x0f0f0f0fu) | ((word & 0x0f0f0f0fu) << 4);
    word = ((word >> 2) & 0x33333333u) | ((word & 0x33333333u) << 2);
    return ((word >> 1) & 0x55555555u) | ((word & 0x55555555u) << 1);
}

}  // namespace

int main(int argc, char** argv) {
    if (argc != 6) {
        std::fprintf(
            stderr, "usage: crush SmallCrush|Crush|BigCrush[-reversed] pixels|realizations|seeds STREAMS WORDS SEED\n");
        return 2;
    }
    std::string name = argv[1];
    const size_t suffix = name.find("-reversed");
    reversed = suffix != std::string::npos;
    name = name.substr(0, suffix);
    battery::Words drawn(argv[2], static_cast<uint32_t>(std::strtoul(argv[3], nullptr, 0)),
                         std::strtoull(argv[4], nullptr, 0), std::strtoull(argv[5], nullptr, 0));
    words = &drawn;
    swrite_Basic = FALSE;
    char title[] = "words of the exact engine";
    unif01_Gen* const generator = unif01_CreateExternGenBits(title, next_word);
    if (name == "SmallCrush")
        bbattery_SmallCrush(generator);
    else if (name == "Crush")
        bbattery_Crush(generator);
    else if (name == "BigCrush")
        bbattery_BigCrush(generator);
    else {
        std::fprintf(stderr, "no such battery: %s\n", argv[1]);
        return 2;
    }
    unif01_DeleteExternGenBits(generator);
    return 0;
}
