// crush BATTERY ORDER STREAMS WORDS SEED [FIRST]: the tests of TestU01's SmallCrush, Crush or BigCrush from the FIRST on,
// on the words of words.h, or on their bits in reverse (BATTERY with the suffix "-reversed"). A line for each p-value, as
// soon as it is known: number of the test, p-value, seconds, name. tests/randomness/report.py builds and runs it.
//
// P. L'Ecuyer, R. Simard, "TestU01: A C library for empirical testing of random number generators", ACM Trans. Math.
// Softw. 33, 22 (2007).
#include "words.h"

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <iterator>

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

struct Battery {
    const char* name;
    int tests;
    void (*repeat)(unif01_Gen*, int*);  // each test as often as an array (tests + 1) says
};

constexpr Battery kBatteries[] = {{"SmallCrush", 10, bbattery_RepeatSmallCrush},
                                  {"Crush", 96, bbattery_RepeatCrush},
                                  {"BigCrush", 106, bbattery_RepeatBigCrush}};

}  // namespace

int main(int argc, char** argv) {
    const std::string asked = argc > 1 ? argv[1] : "", name = asked.substr(0, asked.find("-reversed"));
    const auto battery = std::find_if(std::begin(kBatteries), std::end(kBatteries),
                                      [&](const Battery& each) { return name == each.name; });
    if (battery == std::end(kBatteries) || argc < 6 || argc > 7) {
        std::fprintf(stderr,
                     "usage: crush SmallCrush|Crush|BigCrush[-reversed] pixels|realizations|seeds STREAMS WORDS SEED "
                     "[FIRST]\n");
        return 2;
    }
    reversed = name != asked;
    swrite_Basic = FALSE;
    char title[] = "words of the exact engine";
    unif01_Gen* const generator = unif01_CreateExternGenBits(title, next_word);
    for (int test = argc > 6 ? std::atoi(argv[6]) : 1; test <= battery->tests; ++test) {
        // words of its own for each test, so that a report can go on where it was interrupted
        battery::Words drawn(argv[2], static_cast<uint32_t>(std::strtoul(argv[3], nullptr, 0)),
                             std::strtoull(argv[4], nullptr, 0),
                             std::strtoull(argv[5], nullptr, 0) + (static_cast<uint64_t>(test) << 40));
        words = &drawn;
        std::vector<int> times(static_cast<size_t>(battery->tests) + 1, 0);
        times[static_cast<size_t>(test)] = 1;
        const std::clock_t began = std::clock();
        std::FILE* const out = stdout;
        stdout = std::fopen("/dev/null", "w");  // the battery's own report
        battery->repeat(generator, times.data());
        std::fclose(stdout);
        stdout = out;
        const double seconds = static_cast<double>(std::clock() - began) / CLOCKS_PER_SEC;
        for (int k = 0; k < bbattery_NTests; ++k)
            std::printf("%d,%.6g,%.1f,%s\n", test, bbattery_pVal[k], seconds, bbattery_TestNames[k]);
        std::fflush(stdout);
    }
    unif01_DeleteExternGenBits(generator);
    return 0;
}
