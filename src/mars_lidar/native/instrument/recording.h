// What happens to the registrations of a pixel (docs/detectors.md): the electronics' dead time and limits decide which
// of them are recorded, jitter and the converter's code widths at what time. Times in laser periods.
#pragma once
#include <cstdint>
#include <utility>
#include <vector>

#include "instrument/jitter_table.h"

namespace mars {

struct PulseTable;

// Codes of the converter: a pattern of relative widths that repeats over the bins.
struct CodeTable {
    std::vector<double> edges;         // (codes + 1) in bins, 0 to codes; empty: every code as wide as a bin
    std::vector<float> upper;          // (codes) upper edges
    std::vector<float> codes_per_bin;  // (codes) 1 / width, 0 for a missing code
    std::vector<int32_t> guide;        // first code that ends beyond the start of each of equal cells
    float cells_per_bin = 0.0f, patterns_per_bin = 0.0f;

    void set(std::vector<double> code_edges) {
        edges = std::move(code_edges);
        const size_t codes = edges.size() - 1, cells = kCells * codes;
        upper.assign(edges.begin() + 1, edges.end());
        upper.back() = static_cast<float>(codes);
        for (size_t k = 0; k < codes; ++k) {
            const double width = edges[k + 1] - edges[k];
            codes_per_bin.push_back(width > 0.0 ? static_cast<float>(1.0 / width) : 0.0f);
        }
        cells_per_bin = static_cast<float>(kCells);
        patterns_per_bin = static_cast<float>(1.0 / static_cast<double>(codes));
        guide.resize(cells + 1);
        for (size_t cell = 0, k = 0; cell <= cells; ++cell) {
            while (k + 1 < codes && !(upper[k] > static_cast<float>(cell) / cells_per_bin)) ++k;
            guide[cell] = static_cast<int32_t>(k);
        }
    }

 private:
    static constexpr size_t kCells = 4;  // a bin
};

struct Recording {
    double electronics_dead_time = 0.0;
    int32_t most_per_period = INT32_MAX, most_per_exposure = INT32_MAX;
    const PulseTable* jitter = nullptr;  // density of the jitter but for its tail, or null
    JitterTable jitter_table;            // of a sampled one
    double tail = 0.0, tail_fraction = 0.0;
    CodeTable codes;
};

// The period of a record that jitter has moved over an end of the exposure: on from the other end, so that every record
// is in the exposure.
inline int32_t round_exposure(int32_t cycle, int32_t cycles) {
    if (static_cast<uint32_t>(cycle) < static_cast<uint32_t>(cycles)) return cycle;
    const int32_t rest = cycle % cycles;
    return rest < 0 ? rest + cycles : rest;
}

}  // namespace mars
